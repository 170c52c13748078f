"""checkpoint.npz as splat.ply and one PLY per part; cameras.json, transforms.json and parts.json beside them."""

from drivesplat.workflow.job import job
from drivesplat.export.far_gaussians import read_far, within_reach
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record
from drivesplat.settings.export import SplatJob

with job(snakemake) as current:
    scene, record = read_scene(current.input.scene), read_training_record(current.input.parser)
    checkpoint, far = read_checkpoint(current.input.checkpoint), read_far(current.input.far)
    provenance = current.provenance(scene.provenance, record.provenance, checkpoint.provenance, far.provenance)
    files = SplatFiles(current.output.splat, current.output.cameras, current.output.parts, current.output.transforms)
    export_splat(files, within_reach(checkpoint, far), record, scene, current.settings(SplatJob), provenance)
