"""checkpoint.npz as viewer.html: one page that shows the splat under a mouse."""

from drivesplat.workflow.job import job
from drivesplat.export.far_gaussians import read_far, within_reach
from drivesplat.export.viewer import export_viewer
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import ExportJob

with job(snakemake) as current:
    scene, checkpoint = read_scene(current.input.scene), read_checkpoint(current.input.checkpoint)
    far = read_far(current.input.far)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, far.provenance)
    settings, method = current.settings(ExportJob), current.wildcards.method
    export_viewer(current.output.viewer, within_reach(checkpoint, far), scene, settings, method, provenance)
