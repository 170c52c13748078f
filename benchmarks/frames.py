"""How many frames of a trained scene are rendered in a second, and how long its film takes.

    python -m benchmarks.frames results/0103/street/checkpoint.npz results/0103/scene.json --width 1600 --height 900

The recorded path at 30 frames a second, twice: rendered to bytes in main memory, frame by frame, by themselves; then
as the rule `film` does it, encoded, and read again. The first tenth of the frames is not counted among those a second.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from drivesplat.errors import DriveSplatError
from drivesplat.machine.device import device_name
from drivesplat.model.checkpoint import open_model, read_checkpoint
from drivesplat.rendering.film import Shot, recorded_shot, render_film
from drivesplat.rendering.trajectory import film_path
from drivesplat.scene.scene import Scene, read_scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmJob, TrajectorySettings

WARM_UP = 0.1
"""The share of the frames that is not timed."""


def measure(scene: Scene, checkpoint: dict[str, Any], job: FilmJob, device_settings: DeviceSettings) -> dict[str, Any]:
    """Frames a second and the film's seconds, with what they are of: device, size, number of frames and Gaussians."""
    shot = Shot(scene, film_path(scene, job.camera, job.fps, job.trajectory), job, (job.width, job.height))
    model, device = open_model(checkpoint, device_settings)
    began = time.perf_counter()
    count = len(shot.cameras)
    aside = max(1, int(WARM_UP * count))
    for number, _ in enumerate(recorded_shot(model, shot, device), start=1):
        began = time.perf_counter() if number == aside else began
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
        "frames_per_second": (count - aside) / seconds,
        "film_seconds": film,
        "film_of_seconds": count / job.fps,
    }


def main(words: Sequence[str]) -> int:
    """The command with these words; returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.frames", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("scene", type=Path, help="the scene's scene.json")
    parser.add_argument("--camera", default="CAM_FRONT")
    for name, default in (("width", 1600), ("height", 900), ("fps", 30), ("threads", 8)):
        parser.add_argument(f"--{name}", type=int, default=default)
    told = parser.parse_args(words)
    torch.set_num_threads(told.threads)
    job = FilmJob(
        camera=told.camera, fps=told.fps, width=told.width, height=told.height, horizontal_fov=None, crf=18,
        trajectory=TrajectorySettings(),
    )  # fmt: skip
    checkpoint = read_checkpoint(told.checkpoint)
    print(json.dumps(measure(read_scene(told.scene), checkpoint, job, DeviceSettings(kind="any")), indent=2))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except DriveSplatError as error:
        sys.exit(f"drivesplat: {error}")
