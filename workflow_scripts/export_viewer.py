"""checkpoint.npz as viewer.html: one page that shows the splat under a mouse."""

from drivesplat.workflow.job import job
from drivesplat.export.viewer import export_viewer
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.export import ExportJob

with job(snakemake) as current:
    scene, checkpoint = read_scene(current.input.scene), read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, checkpoint.provenance)
    settings, method = current.settings(ExportJob), current.wildcards.method
    export_viewer(current.output.viewer, checkpoint, scene, settings, method, provenance)
