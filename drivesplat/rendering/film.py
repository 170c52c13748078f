"""The stages `film` and `film_parts`: films of a trained model along a trajectory, with a record of their cameras; and
films of its static and dynamic parts side by side."""

import logging
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.video import write_video
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.captions import captioned, last_training_second
from drivesplat.rendering.frames import film_frame, film_frames, uint8_image
from drivesplat.rendering.trajectory import CameraPath, film_intrinsics, film_path, recorded_frames
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmFormat, FilmJob, TrajectorySettings

log = logging.getLogger(__name__)

BACKDROP = 0.35
"""Grey level behind dynamic parts that are rendered alone."""


@dataclass(frozen=True)
class Shot:
    """A camera path through a scene and the intrinsics of its film; `size` is width and height in pixels."""

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
        """The cameras in order, on the device."""
        intrinsics = torch.from_numpy(self.K).float().to(device)
        poses = torch.from_numpy(self.cameras.camera_to_world).float().to(device)
        for pose, seconds in zip(poses, self.seconds, strict=True):
            yield View(intrinsics, pose, *self.size, time=seconds)

    @property
    def seconds(self) -> list[float]:
        """The time of each frame, since the first image of the scene."""
        return [self.scene.seconds(timestamp) for timestamp in self.cameras.timestamps]

    @cached_property
    def trained_until(self) -> float:
        """The second of the camera's last training image; infinite if there is none."""
        return last_training_second(self.scene, self.format.camera, self.format.holdout)

    def record(self) -> dict[str, Any]:
        """The cameras of the film, for other programs.

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
    scene: Scene, checkpoint: TrainedCheckpoint, job: FilmJob, device_settings: DeviceSettings, path: Path
) -> dict[str, Any]:
    """Writes the MP4 `path`; returns the content of the record of its cameras without provenance: that of the shot, the
    `offset` from the recorded path in metres and degrees, `render_seconds` and `bytes`.

    Raises DatasetError where the scene lacks the camera, DeviceError,
    and ResultError where the film cannot be written or a rendering contains NaN or Inf.
    """
    shot = Shot(scene, film_path(scene, job.camera, job.fps, job.trajectory), job, (job.width, job.height))
    model, device = open_model(checkpoint, device_settings)
    figures = write_film(path, recorded_shot(model, shot, device), shot, model, [f"{path.parent.name}: {path.stem}"])
    return {**shot.record(), "offset": job.trajectory.model_dump(), **figures}


def render_parts(
    scene: Scene, checkpoint: TrainedCheckpoint, job: FilmFormat, device_settings: DeviceSettings, path: Path
) -> dict[str, Any]:
    """Writes the MP4 `path` of three images side by side along the recorded path: the scene, its static parts, and its
    dynamic parts on plain grey. Returns the record of its cameras as `render_film` does, with the size of one image.
    Raises what `render_film` raises.
    """
    shot = Shot(scene, film_path(scene, job.camera, job.fps, TrajectorySettings()), job, job.tile(3))
    model, device = open_model(checkpoint, device_settings)
    model.precompute(shot.seconds)
    pictures = (_static_and_dynamic(model, view) for view in shot.views(device))
    figures = write_film(path, pictures, shot, model, ["everything", "static", "moving"])
    return {**shot.record(), "shows": ["all", "still", "moving"], **figures}


def write_film(
    path: Path, pictures: Iterable[np.ndarray], shot: Shot, model: SplatModel, labels: Sequence[str]
) -> dict[str, Any]:
    """Writes an MP4 of one image (h, w, 3) uint8 for each camera of `shot`, with a column as wide as a view of it for
    each of `labels`, which its captions show; returns `render_seconds` and `bytes`.

    Raises DeviceError, which tells the size of `model`, where memory is exhausted, and ResultError where the film
    cannot be written.
    """
    began, count = time.perf_counter(), len(shot.cameras)
    if shot.format.captions:
        pictures = captioned(pictures, shot.seconds, labels, shot.trained_until)
    frames = tqdm(
        prefetch_items(pictures),
        total=count,
        desc=path.stem,
        unit="frame",
        disable=not sys.stderr.isatty(),
        mininterval=1.0,
    )
    size = (len(labels) * shot.size[0], shot.size[1])
    with explain_out_of_memory(lambda: len(model)):
        write_video(path, iter(frames), size, shot.format.fps, shot.format.crf, threads=torch.get_num_threads())
    seconds = time.perf_counter() - began
    log.info("%s: %d frames, %.1f s, %.3f s a frame", path.name, count, seconds, seconds / count)
    return {"render_seconds": seconds, "bytes": path.stat().st_size}


def recorded_shot(model: SplatModel, shot: Shot, device: torch.device) -> Iterator[np.ndarray]:
    """The frames of a shot of a model without edits, (h, w, 3) uint8 RGB."""
    model.precompute(shot.seconds)
    return film_frames(model, ((view, None) for view in shot.views(device)))


@torch.no_grad()
def _static_and_dynamic(model: SplatModel, view: View) -> np.ndarray:
    """The scene, its static parts and its dynamic parts side by side: (h, 3 w, 3) uint8."""
    gaussians, dynamic = model.gaussians_at(view.time), model.moving()
    objects = model.render(view, gaussians=gaussians[dynamic])
    on_grey = objects.splats + BACKDROP * (1.0 - objects.alpha[..., None])
    scene, static = (film_frame(model, view, rendered) for rendered in (gaussians, gaussians[~dynamic]))
    return np.hstack([scene, static, uint8_image(on_grey)])
