"""The stage `quad`: a drive in four panels of one film: its recorded images, their reconstruction, the smooth
drive between them, and an edit of it."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch

from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.film import edited_frames, edited_shots
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.view import View
from drivesplat.rendering.film import Shot, recorded_shot, write_film
from drivesplat.rendering.frames import film_frames
from drivesplat.rendering.panels import Panels
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import EditJob
from drivesplat.trajectories.camera_path import recorded_frames

T = TypeVar("T")


def render_quad(
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    job: EditJob,
    device_settings: DeviceSettings,
    path: Path,
    inserts: Inserts = NO_INSERTS,
    frames_file: Path | None = None,
) -> dict[str, Any]:
    """Writes the MP4 `path`, named like the edit, which inserts `inserts`; returns the content of its JSON
    without provenance. `frames_file` is as in `render_edit`.

    The first two panels show the last image of the camera until the next: as recorded, and rendered from its pose at
    its time. Raises what `render_edit` raises.
    """
    model, device = open_model(checkpoint, device_settings)
    drive = edited_shots(scene, model, job, f"scene {scene.name}, edit {path.stem!r}", inserts)
    smooth, after = drive.before, drive.after
    frames = recorded_frames(scene, job.camera)
    times = np.array([frame.timestamp for frame in frames])
    last = np.searchsorted(times, smooth.cameras.timestamps, side="right") - 1
    taken = [frames[number] for number in np.unique(last)]
    poses = [torch.from_numpy(frame.camera_to_world).float().to(device) for frame in taken]
    K = torch.from_numpy(smooth.K).float().to(device)
    views = (
        View(K, pose, *smooth.size, time=scene.seconds(frame.timestamp))
        for frame, pose in zip(taken, poses, strict=True)
    )
    model.precompute([*smooth.seconds, *(scene.seconds(frame.timestamp) for frame in taken)])
    columns = (
        repeated(last, (recorded_picture(frame, smooth) for frame in taken)),
        repeated(last, film_frames(model, ((view, None) for view in views))),
        recorded_shot(model, smooth, device, frames_file),
        edited_frames(drive.model, after.views(device), drive.actors, np.array(after.seconds)),
    )
    rate = f"{1e6 / float(np.median(np.diff(times))) if len(times) > 1 else 0.0:.2g} Hz"
    labels = (f"recorded, {rate}", f"reconstructed, {rate}", f"smooth, {job.fps} fps", f"edited: {path.stem}")
    panels = Panels(labels, smooth.size)
    figures = write_film(path, map(panels.assembled, zip(*columns, strict=True)), after, model, panels, drive.notes)
    return {**after.record(), "film": panels.record(), "edit": job.edit.model_dump(mode="json"), **figures}


def repeated(last: np.ndarray, pictures: Iterable[T]) -> Iterator[T]:
    """A picture for each entry of `last` (n,): the next one wherever the entry changes."""
    remaining = iter(pictures)
    for changes in np.diff(last, prepend=-1) != 0:
        if changes:
            shown = next(remaining)
        yield shown


def recorded_picture(frame: Frame, shot: Shot) -> np.ndarray:
    """A recorded image with the intrinsics of a shot, (h, w, 3) uint8; black where it ends."""
    own = continuous_intrinsics(frame, (frame.width, frame.height))
    scale = shot.K[0, 0] / own[0, 0]
    size = max(1, round(scale * frame.width)), max(1, round(scale * frame.height))
    image = read_image(frame.image_path, size)
    offset = shot.K[:2, 2] - continuous_intrinsics(frame, size)[:2, 2]
    return cv2.warpAffine(image, np.column_stack([np.eye(2), offset]), shot.size)
