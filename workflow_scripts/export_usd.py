"""checkpoint.npz as scene.usdz: static and dynamic Gaussians in OpenUSD's schema, and the recording camera."""

from drivesplat.workflow.job import job
from drivesplat.export.far_gaussians import read_far, within_reach
from drivesplat.export.usd import export_usd
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import ExportJob

with job(snakemake) as current:
    scene, checkpoint = read_scene(current.input.scene), read_checkpoint(current.input.checkpoint)
    far = read_far(current.input.far)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, far.provenance)
    export_usd(current.output.usd, within_reach(checkpoint, far), scene, current.settings(ExportJob), provenance)
