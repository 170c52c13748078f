"""The stages `film` and `film_parts`: films of a trained model along a trajectory, with a record of their cameras; and
films of its static and dynamic parts side by side. And the stage `recorded_frames`: the frames along the recorded path,
for films that show them beside others."""

import logging
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from drivesplat.io.prefetch import prefetch_items
from drivesplat.io.storage import atomic_write, unreadable
from drivesplat.io.video import write_video
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.gaussians import concatenate
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.captions import Caption, captioned, drive_captions
from drivesplat.rendering.color_bytes import uint8_image
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.rendering.frames import film_frame, film_frames
from drivesplat.rendering.panels import Panels
from drivesplat.scene.images import target_size
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import last_training_timestamp
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import PARTS_IN_WORDS, FilmEncoding, FilmFormat, FilmJob, ShownParts, TrajectorySettings
from drivesplat.trajectories.camera_path import CameraPath, film_intrinsics, film_path, recorded_frames

log = logging.getLogger(__name__)

MAX_WIDTH = 1920
"""Maximum width of films in pixels where the settings name no size."""
BACKDROP = 0.35
"""Grey level behind dynamic parts that are rendered alone."""
PARTS_SHOWN: tuple[ShownParts, ...] = ("all", "static", "moving")
"""The panels of the film of parts."""


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
        last = last_training_timestamp(self.scene, self.format.camera, self.format.holdout)
        return np.inf if last is None else self.scene.seconds(last)

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


def shot_of(scene: Scene, cameras: CameraPath, form: FilmFormat) -> Shot:
    """The shot of a film along `cameras`, up to where `form.end` says. A camera without training images has all."""
    shot = Shot(scene, cameras, form, film_size(scene, form))
    if form.end == "recorded":
        return shot
    shown = np.array(shot.seconds) <= shot.trained_until
    return replace(shot, cameras=cameras[: max(1, np.count_nonzero(shown))])


def film_size(scene: Scene, job: FilmFormat) -> tuple[int, int]:
    """Width and height of a film in pixels, both even: as the settings say, otherwise those of the training images, at
    most MAX_WIDTH wide, with their aspect ratio. Raises DatasetError where the scene lacks the camera."""
    own_width, own_height = target_size(recorded_frames(scene, job.camera)[0], job.images)
    width = job.width or (job.height * own_width / own_height if job.height else min(own_width, MAX_WIDTH))
    height = job.height or width * own_height / own_width
    return max(16, 2 * round(width / 2)), max(16, 2 * round(height / 2))


def render_film(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: FilmJob,
    device_settings: DeviceSettings,
    path: Path,
    frames_file: Path | None = None,
) -> dict[str, Any]:
    """Writes the MP4 `path`; returns the content of the record of its cameras without provenance: that of the shot, the
    `offset` from the recorded path in metres and degrees, the `parts` shown, `render_seconds` and `bytes`.
    `frames_file` is the file of `write_recorded_frames` for a film along the recorded path; without it, frames are
    rendered.

    Raises DatasetError where the scene lacks the camera, DeviceError,
    and ResultError where the film cannot be written or a rendering contains NaN or Inf.
    """
    shot = shot_of(scene, film_path(scene, job.camera, job.fps, job.trajectory), job)
    model, device = open_model(checkpoint, device_settings)
    panels = Panels((f"{path.parent.name}: {job.trajectory.in_words}",), shot.size)
    parts = job.trajectory.parts
    if parts == "all":
        pictures = recorded_shot(model, shot, device, frames_file)
    else:
        model.precompute(shot.seconds)
        fixed = FixedModel(model)
        pictures = (frames_of_parts(fixed, view, [parts])[0] for view in shot.views(device))
    figures = write_film(path, pictures, shot, model, panels)
    return {**shot.record(), "offset": job.trajectory.model_dump(exclude={"parts"}), "parts": parts, **figures}


def render_parts(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: FilmFormat,
    device_settings: DeviceSettings,
    path: Path,
    frames_file: Path | None = None,
) -> dict[str, Any]:
    """Writes the MP4 `path` of three panels along the recorded path: the scene, its static parts, and its dynamic parts
    on plain grey. Returns the record of its cameras as `render_film` does, for one panel, with the `film` of all.
    `frames_file` is as in `render_film`. Raises what `render_film` raises.
    """
    shot = shot_of(scene, film_path(scene, job.camera, job.fps, TrajectorySettings()), job)
    model, device = open_model(checkpoint, device_settings)
    panels = Panels(("everything", "static", "moving"), shot.size)
    model.precompute(shot.seconds)
    fixed = FixedModel(model)
    shown = PARTS_SHOWN if frames_file is None else PARTS_SHOWN[1:]
    apart = (frames_of_parts(fixed, view, shown) for view in shot.views(device))
    if frames_file is not None:
        whole = recorded_shot(model, shot, device, frames_file)
        apart = ([frame, *others] for frame, others in zip(whole, apart, strict=True))
    captions = [PARTS_IN_WORDS[parts] for parts in PARTS_SHOWN]
    figures = write_film(path, map(panels.assembled, apart), shot, model, panels, labels=captions)
    return {**shot.record(), "shows": ["all", "still", "moving"], "film": panels.record(), **figures}


def write_film(
    path: Path,
    pictures: Iterable[np.ndarray],
    shot: Shot,
    model: SplatModel,
    panels: Panels,
    notes: Sequence[str] = (),
    labels: Sequence[str] = (),
) -> dict[str, Any]:
    """Writes an MP4 of one picture of `panels` for each camera of `shot`, with the captions of the drive and `notes`;
    returns `render_seconds` and `bytes`. `labels` are what captions say of each panel, by default its own label.

    Raises DeviceError, which tells the size of `model`, where memory is exhausted, and ResultError where the film
    cannot be written.
    """
    captions = drive_captions(labels or panels.labels, shot.seconds, shot.trained_until, notes)
    with explain_out_of_memory(lambda: len(model)):
        frames = zip(pictures, captions, strict=True)
        return encode_film(path, frames, len(captions), panels, shot.format)


def encode_film(
    path: Path, frames: Iterable[tuple[np.ndarray, Caption]], count: int, panels: Panels, form: FilmEncoding
) -> dict[str, Any]:
    """Writes an MP4 of `count` pictures (h, w, 3) uint8 of `panels`, with their captions if `form` has them; returns
    `render_seconds` and `bytes`. Raises ResultError where the film cannot be written."""
    began = time.perf_counter()
    pictures = captioned(frames, panels) if form.captions else (picture for picture, _ in frames)
    shown = tqdm(
        prefetch_items(pictures),
        total=count,
        desc=path.stem,
        unit="frame",
        disable=not sys.stderr.isatty(),
        mininterval=1.0,
    )
    write_video(path, iter(shown), panels.film_size, form.fps, form.crf, threads=torch.get_num_threads())
    seconds = time.perf_counter() - began
    log.info("%s: %d frames, %.1f s, %.3f s a frame", path.name, count, seconds, seconds / count)
    return {"render_seconds": seconds, "bytes": path.stat().st_size}


def recorded_shot(
    model: SplatModel, shot: Shot, device: torch.device, frames_file: Path | None = None
) -> Iterator[np.ndarray]:
    """The frames of a shot of a model without edits, (h, w, 3) uint8 RGB. For a shot along the recorded path, or its
    beginning, `frames_file` is the file of `write_recorded_frames`; without it, frames are rendered.

    Raises ResultError where the file is damaged, or lacks frames of that number and size.
    """
    model.precompute(shot.seconds)
    if frames_file is None:
        return film_frames(model, ((view, None) for view in shot.views(device)))
    try:
        frames = np.load(frames_file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise unreadable(frames_file, "recorded_frames", f"no file of frames ({error})") from error
    count, (width, height) = len(shot.cameras), shot.size
    if frames.dtype != np.uint8 or frames.shape[1:] != (height, width, 3) or len(frames) < count:
        found = f"{frames.dtype} {frames.shape}"
        why = f"contains {found} in place of {count} frames of {width}x{height}"
        raise unreadable(frames_file, "recorded_frames", why)
    return iter(frames[:count])


def write_recorded_frames(
    scene: Scene, checkpoint: TrainedCheckpoint, form: FilmFormat, device_settings: DeviceSettings, path: Path
) -> None:
    """Writes the frames of a film along the recorded path, without captions, as an NPY file (n, h, w, 3) uint8 RGB.

    Films of other formats with the same camera, size, rate and end have the same frames. Raises what `render_film`
    raises.
    """
    shot = shot_of(scene, film_path(scene, form.camera, form.fps, TrajectorySettings()), form)
    model, device = open_model(checkpoint, device_settings)
    size = (len(shot.cameras), *reversed(shot.size), 3)
    header = {"descr": np.lib.format.dtype_to_descr(np.dtype(np.uint8)), "fortran_order": False, "shape": size}
    with atomic_write(path) as file, explain_out_of_memory(lambda: len(model)):
        np.lib.format.write_array_header_1_0(file, header)
        for frame in recorded_shot(model, shot, device):
            file.write(np.ascontiguousarray(frame).data)


@torch.no_grad()
def frames_of_parts(fixed: FixedModel, view: View, shown: Sequence[ShownParts]) -> list[np.ndarray]:
    """A view (h, w, 3) uint8 of everything, of the static or of the moving parts, for each of `shown`. Moving parts are
    before plain grey."""
    model, gaussians = fixed.model, concatenate(fixed.sample_in(view))
    dynamic = model.moving()

    def frame(parts: ShownParts) -> np.ndarray:
        if parts != "moving":
            return film_frame(model, view, gaussians if parts == "all" else gaussians[~dynamic])
        objects = model.render(view, gaussians=gaussians[dynamic])
        return uint8_image(objects.splats + BACKDROP * (1.0 - objects.alpha[..., None]))

    return [frame(parts) for parts in shown]
