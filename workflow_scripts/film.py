"""checkpoint.npz along a trajectory, into an MP4 and the record of its cameras."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.rendering.film import render_film
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import FilmJob

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, checkpoint.provenance)
    frames = next(map(Path, current.input.frames), None)
    film = Path(current.output.film)
    record = render_film(scene, checkpoint, current.settings(FilmJob), current.device(), film, frames)
    write_json(current.output.cameras, {**record, "provenance": provenance})
