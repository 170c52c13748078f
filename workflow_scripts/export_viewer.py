"""checkpoint.npz as viewer.html: one page that shows the splat under a mouse."""

from drivesplat.workflow.job import job
from drivesplat.editing.sampled_edits import sampled_edits
from drivesplat.export.far_gaussians import read_far, within_reach
from drivesplat.export.sampled_motion import SAMPLES_PER_SECOND
from drivesplat.export.viewer import export_viewer
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record
from drivesplat.settings.export import ViewerJob

with job(snakemake, dataset=("images",)) as current:
    files, settings, method = current.input, current.settings(ViewerJob), current.wildcards.method
    scene, record, far = read_scene(files.scene), read_training_record(files.parser), read_far(files.far)
    checkpoint = read_checkpoint(files.checkpoint)
    provenance = current.provenance(*(made.provenance for made in (scene, record, checkpoint, far)))
    shown = within_reach(checkpoint, far)
    edits = sampled_edits(shown, scene, settings.eval_camera, settings.edits, SAMPLES_PER_SECOND)
    export_viewer(current.output.viewer, shown, scene, record, settings, method, edits, provenance)
