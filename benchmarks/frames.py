"""Rendering rate of a trained scene, and the time of its film.

    python -m benchmarks.frames results/0103/street/checkpoint.npz results/0103/scene.json --width 1600 --height 900

Renders the recorded path at 30 frames per second twice: to bytes in main memory, frame by frame; then as the rule
`film` does, encoded and verified. The first tenth of the frames is left out of the rate.
"""

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.command import argument_parser, run_command
from drivesplat.machine.device import device_name
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model, read_checkpoint
from drivesplat.rendering.film import Shot, recorded_shot, render_film
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob, TrajectorySettings
from drivesplat.trajectories.camera_path import film_path

WARM_UP = 0.1
"""The share of the frames before timing starts."""


def measure(
    scene: Scene, checkpoint: TrainedCheckpoint, job: FilmJob, device_settings: DeviceSettings
) -> dict[str, Any]:
    """Frames per second and the film's seconds, with device, image size, number of frames and Gaussians."""
    shot = Shot(scene, film_path(scene, job.camera, job.fps, job.trajectory), job, (job.width, job.height))
    model, device = open_model(checkpoint, device_settings)
    began = time.perf_counter()
    count = len(shot.cameras)
    warm_up = max(1, int(WARM_UP * count))
    for number, _ in enumerate(recorded_shot(model, shot, device), start=1):
        began = time.perf_counter() if number == warm_up else began
    seconds = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        render_film(scene, checkpoint, job, device_settings, Path(folder) / "film.mp4")
        film = time.perf_counter() - began
    return {
        "device": device_name(device),
        "width": job.width,
        "height": job.height,
        "gaussians": len(model),
        "frames": count,
        "frames_per_second": (count - warm_up) / seconds,
        "film_seconds": film,
        "film_of_seconds": count / job.fps,
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command with these arguments; returns its exit status."""
    parser = argument_parser("frames", __doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("scene", type=Path, help="the scene's scene.json")
    parser.add_argument("--camera", default="CAM_FRONT")
    for name, default in (("width", 1600), ("height", 900), ("fps", 30), ("threads", 8)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    job = FilmJob(
        camera=options.camera, fps=options.fps, width=options.width, height=options.height, horizontal_fov=None, crf=18,
        trajectory=TrajectorySettings(),
    )  # fmt: skip
    checkpoint = read_checkpoint(options.checkpoint)
    print(json.dumps(measure(read_scene(options.scene), checkpoint, job, DeviceSettings(kind="any")), indent=2))
    return 0


if __name__ == "__main__":
    run_command(main)
