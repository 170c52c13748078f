"""checkpoint.npz and the recorded images, into a film of four panels: recorded, reconstructed, smooth, edited."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.editing.quad import render_quad
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import EditJob

with job(snakemake, dataset=("images",)) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, checkpoint.provenance)
    record = render_quad(scene, checkpoint, current.settings(EditJob), current.device(), Path(current.output.film))
    write_json(current.output.labels, {**record, "provenance": provenance})
