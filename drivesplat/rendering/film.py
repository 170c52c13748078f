"""The stages `film` and `film_parts`: a trained model along a trajectory, as a film and the cameras that it was seen
from; and taken apart into what stands still and what moves."""

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from drivesplat.io.prefetch import in_advance
from drivesplat.io.video import write_video
from drivesplat.machine.device import telling_out_of_memory
from drivesplat.model.checkpoint import open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.frames import as_bytes, film_frame, film_frames
from drivesplat.rendering.trajectory import CameraPath, film_intrinsics, film_path, recorded_frames
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmFormat, FilmJob, TrajectorySettings

log = logging.getLogger(__name__)

BACKDROP = 0.35
"""Grey behind objects that are shown by themselves."""


@dataclass(frozen=True)
class Shot:
    """A camera along a path through a scene, with a lens; `size` is width and height in pixels."""

    scene: Scene
    cameras: CameraPath
    format: FilmFormat
    size: tuple[int, int]

    @cached_property
    def K(self) -> np.ndarray:
        """Intrinsics (3, 3) in continuous pixels at `size`."""
        frame = recorded_frames(self.scene, self.format.camera)[0]
        return film_intrinsics(frame, *self.size, self.format.horizontal_fov)

    def views(self, device: torch.device) -> Iterator[View]:
        """The cameras one by one, on the device."""
        intrinsics = torch.from_numpy(self.K).float().to(device)
        poses = torch.from_numpy(self.cameras.camera_to_world).float().to(device)
        for pose, seconds in zip(poses, self.seconds, strict=True):
            yield View(intrinsics, pose, *self.size, time=seconds)

    @property
    def seconds(self) -> list[float]:
        """When each frame is seen, since the first image of the scene."""
        return [self.scene.seconds(timestamp) for timestamp in self.cameras.timestamps]

    def record(self) -> dict[str, Any]:
        """What another program needs to see what the film sees.

        `K` in continuous pixels; `timestamps` microseconds; `camera_to_world` OpenCV cameras in world metres, z up;
        global = world + `origin`.
        """
        return {
            "schema": 1,
            "camera": self.format.camera,
            "fps": self.format.fps,
            "width": self.size[0],
            "height": self.size[1],
            "frames": len(self.cameras),
            "duration_s": len(self.cameras) / self.format.fps,
            "K": self.K.tolist(),
            "timestamps": self.cameras.timestamps.tolist(),
            "camera_to_world": self.cameras.camera_to_world.tolist(),
            "origin": self.scene.origin.tolist(),
        }


def render_film(
    scene: Scene, checkpoint: dict[str, Any], job: FilmJob, device_settings: DeviceSettings, path: Path
) -> dict[str, Any]:
    """Writes the MP4 `path`; returns the content of the record of its cameras, provenance aside: the shot's, `offset`,
    in metres and degrees from the recorded path, and what writing took.

    `checkpoint` is the content of checkpoint.pt. Raises DatasetError where the scene lacks the camera, DeviceError,
    and ResultError where the film cannot be written or the model renders no numbers.
    """
    shot = Shot(scene, film_path(scene, job.camera, job.fps, job.trajectory), job, (job.width, job.height))
    model, device = open_model(checkpoint, device_settings)
    taken = write_film(path, recorded_shot(model, shot, device), shot, model)
    return {**shot.record(), "offset": job.trajectory.model_dump(), **taken}


def render_parts(
    scene: Scene, checkpoint: dict[str, Any], job: FilmFormat, device_settings: DeviceSettings, path: Path
) -> dict[str, Any]:
    """Writes the MP4 `path` of three pictures side by side along the recorded path: everything, what stands still, and
    what moves before plain grey, which is all there is to see where nothing does. Returns the record of its cameras, as
    `render_film` does; its size is one picture's. Raises what `render_film` raises.
    """
    shot = Shot(scene, film_path(scene, job.camera, job.fps, TrajectorySettings()), job, job.tile(3))
    model, device = open_model(checkpoint, device_settings)
    model.precompute(shot.seconds)
    taken = write_film(path, (_apart(model, view) for view in shot.views(device)), shot, model, columns=3)
    return {**shot.record(), "shows": ["all", "still", "moving"], **taken}


def write_film(
    path: Path, pictures: Iterable[np.ndarray], shot: Shot, model: SplatModel, columns: int = 1
) -> dict[str, Any]:
    """Writes an MP4 of one picture (h, w, 3) uint8 a camera of `shot`, `columns` times as wide as a view of it; returns
    what that took, `render_seconds` and `bytes`.

    `model` is the one shown, to be named where memory does not suffice. Raises DeviceError then, and ResultError where
    the film cannot be written.
    """
    began, count = time.perf_counter(), len(shot.cameras)
    shown = tqdm(
        in_advance(pictures),
        total=count,
        desc=path.stem,
        unit="frame",
        disable=not sys.stderr.isatty(),
        mininterval=1.0,
    )
    size = (columns * shot.size[0], shot.size[1])
    with telling_out_of_memory(lambda: len(model)):
        write_video(path, iter(shown), size, shot.format.fps, shot.format.crf, threads=torch.get_num_threads())
    seconds = time.perf_counter() - began
    log.info("%s: %d frames, %.1f s, %.3f s a frame", path.name, count, seconds, seconds / count)
    return {"render_seconds": seconds, "bytes": path.stat().st_size}


def recorded_shot(model: SplatModel, shot: Shot, device: torch.device) -> Iterator[np.ndarray]:
    """The frames of a shot of a model, everything being as it was recorded, (h, w, 3) uint8 RGB."""
    model.precompute(shot.seconds)
    return film_frames(model, ((view, None) for view in shot.views(device)))


@torch.no_grad()
def _apart(model: SplatModel, view: View) -> np.ndarray:
    """Everything, what stands still, and what moves by itself, side by side: (h, 3 w, 3) uint8."""
    gaussians, moving = model.gaussians_at(view.time), model.moving()
    objects = model.render(view, gaussians=gaussians[moving])
    before_grey = objects.splats + BACKDROP * (1.0 - objects.alpha[..., None])
    everything, still = (film_frame(model, view, shown) for shown in (gaussians, gaussians[~moving]))
    return np.hstack([everything, still, as_bytes(before_grey)])
