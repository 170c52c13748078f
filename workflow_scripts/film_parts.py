"""checkpoint.pt taken apart along the recorded path, into parts.mp4 and the record of its cameras."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.rendering.film import render_parts
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import FilmFormat
from drivesplat.training.run import read_checkpoint

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, checkpoint["provenance"])
    record = render_parts(scene, checkpoint, current.settings(FilmFormat), current.device(), Path(current.output.film))
    write_json(current.output.cameras, {**record, "provenance": provenance})
