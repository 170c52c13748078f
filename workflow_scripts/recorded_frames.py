"""checkpoint.npz along the recorded path, into the frames that films show beside others."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.rendering.film import write_recorded_frames
from drivesplat.scene.scene import read_scene
from drivesplat.settings.render import FilmFormat

with job(snakemake) as current:
    scene = read_scene(current.input.scene)
    checkpoint = read_checkpoint(current.input.checkpoint)
    write_recorded_frames(
        scene, checkpoint, current.settings(FilmFormat), current.device(), Path(current.output.frames)
    )
