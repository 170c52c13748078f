"""checkpoint.npz with its actors in other roles, into a film, a still and labels."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.editing.film import EditFiles, render_edit
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import EditJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    settings = current.settings(EditJob)
    inserts = read_inserts(settings.edit, Path(current.input.checkpoint).parent)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, inputs=digests_of(inserts))
    files = EditFiles(Path(current.output.film), Path(current.output.still))
    frames = next(map(Path, current.input.frames), None)
    record = render_edit(scene, checkpoint, settings, current.device(), files, inserts, frames)
    write_json(current.output.labels, {**record, "provenance": provenance})
