"""checkpoint.npz as splat.ply, in the convention of splat viewers, its parts likewise, cameras.json and parts.json."""

from drivesplat.workflow.job import job
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record

with job(snakemake) as current:
    scene, record = read_scene(current.input.scene), read_training_record(current.input.parser)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, record.provenance, checkpoint.provenance)
    files = SplatFiles(current.output.splat, current.output.cameras, current.output.parts)
    export_splat(files, checkpoint, record, scene, provenance)
