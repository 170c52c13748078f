"""checkpoint.npz and the recorded images, into a film of four panels: recorded, reconstructed, smooth, edited."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.assets.library import digests_of, read_inserts
from drivesplat.editing.quad import render_quad
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import EditJob

with job(snakemake, dataset=("images",)) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    settings = current.settings(EditJob)
    inserts = read_inserts(settings.edit, Path(current.input.checkpoint).parent)
    provenance = current.provenance(scene.provenance, checkpoint.provenance, inputs=digests_of(inserts))
    film = Path(current.output.film)
    frames = next(map(Path, current.input.frames), None)
    record = render_quad(scene, checkpoint, settings, current.device(), film, inserts, frames)
    write_json(current.output.labels, {**record, "provenance": provenance})
