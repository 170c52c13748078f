"""A rendered drive as a `Scene` of images to render: the recorded drive after an edit, or seen from beside its path."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from drivesplat.editing.actors import (
    edited_model,
    other_objects,
    trained_actors,
    warn_of_collisions,
)
from drivesplat.editing.assets.asset import NO_INSERTS, Inserts
from drivesplat.editing.ego import EgoEdit
from drivesplat.editing.shown_objects import ShownObjects
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.scene.images import continuous_intrinsics, target_size
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.scene.sensors import Camera
from drivesplat.settings.export import DriveJob
from drivesplat.settings.images import ImageSettings
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.camera_path import displaced, recorded_frames
from drivesplat.trajectories.edited_actors import EditedActor

LABEL_INTERVAL = 100_000
"""Microseconds between the poses of an object in labels, besides those at key frames."""
IMAGE_SUFFIX = ".jpg"
RENDERED = "rendered"
"""The source of the poses of a rendered drive."""


@dataclass(frozen=True)
class ImageRenderPlan:
    """A drive to render. `scene` has its images, by their paths to be, which the model shows at `seconds` (n,); its
    tracks are all annotated objects at key frames, and `tracks` are the same at LABEL_INTERVAL. `objects` are what the
    model shows of them; `edited`: whether it has the actors of an edit."""

    scene: Scene
    seconds: np.ndarray
    tracks: tuple[Track, ...]
    objects: ShownObjects
    edited: bool

    def views(self, device: torch.device) -> Iterator[View]:
        """The cameras of the images in order, on the device, as films have them: with the colours and the poses of the
        model itself, without corrections of cameras of the rig."""
        for frame, seconds in zip(self.scene.frames, self.seconds.tolist(), strict=True):
            size = (frame.width, frame.height)
            yield View(
                K=torch.from_numpy(continuous_intrinsics(frame, size)).float().to(device),
                camera_to_world=torch.from_numpy(frame.camera_to_world).float().to(device),
                width=size[0],
                height=size[1],
                time=seconds,
            )


def image_render_plan(
    scene: Scene, model: SplatModel, job: DriveJob, folder: Path, where: str, inserts: Inserts = NO_INSERTS
) -> ImageRenderPlan:
    """The drive of `job`, whose edit inserts `inserts`; its images are to lie in `folder`/images.

    All images of the cameras at their own times, as long as the ego vehicle is on its recorded path. Warns where a
    camera is inside a vehicle. Raises ConfigError, starting with `where`, if the edit does not fit the scene
    or the model has no actors; DatasetError if the scene lacks a camera.
    """
    if job.edit is None:
        ego, trained = None, trained_actors(model, scene, where)
        actors = trained
    else:
        edited = edited_model(model, scene, job.eval_camera, job.edit, where, inserts)
        model, trained, actors = edited.model, edited.recorded, edited.actors
        ego = EgoEdit.of(scene, job.eval_camera, job.edit, where)
    frames = [frame for camera in job.cameras for frame in _rendered_frames(scene, camera, ego, job, folder)]
    last = max((frame.sample_index for frame in frames if frame.is_key_frame), default=0)
    frames = [replace(frame, sample_index=min(frame.sample_index, last)) for frame in frames]
    seconds = _seconds(scene, frames)
    warn_of_collisions(actors, np.stack([frame.camera_to_world for frame in frames]), seconds, where)
    others, key_times = other_objects(scene, trained), scene.key_frame_timestamps[: last + 1]
    objects = [*actors, *others]
    times = [*key_times.tolist(), *(frame.timestamp for frame in frames)]
    label_times = np.union1d(key_times, np.arange(min(times), max(times) + 1, LABEL_INTERVAL))
    first = {frame.camera: frame for frame in reversed(frames)}
    rendered = replace(
        scene,
        key_frame_timestamps=key_times,
        frames=tuple(frames),
        sweeps=(),
        tracks=_tracks(scene, objects, key_times),
        poses=RENDERED,
        key_frame_range=None,
        missing_images=0,
        # they record all pixels at once, without distortion
        cameras=tuple(
            Camera(name, frame.width, frame.height, frame.intrinsics, distortion=np.zeros(5), readout_s=0.0)
            for name, frame in sorted(first.items())
        ),
        lidars=(),
        provenance={},
    )
    shown = ShownObjects.of_scene(scene, model, actors, others)
    return ImageRenderPlan(rendered, seconds, _tracks(scene, objects, label_times), shown, job.edit is not None)


def _rendered_frames(scene: Scene, camera: str, change: EgoEdit | None, job: DriveJob, folder: Path) -> list[Frame]:
    """The images of a camera at the width of the job, with the poses after a change of the ego vehicle's path, or
    beside the recorded path, and intrinsics in OpenCV's convention."""
    frames = recorded_frames(scene, camera)
    camera_to_world = np.stack([frame.camera_to_world for frame in frames])
    ego_to_world = np.stack([frame.ego_to_world for frame in frames])
    trajectory = job.trajectory
    if change is not None:
        seconds = _seconds(scene, frames)
        within = change.within(frames, seconds)
        camera_to_world, ego_to_world = change.poses(frames, seconds[within])
        frames = [frame for frame, inside in zip(frames, within, strict=True) if inside]
    elif trajectory is not None and trajectory != TrajectorySettings():
        aside = TrajectorySettings(lateral=trajectory.lateral)
        camera_to_world = displaced(camera_to_world, ego_to_world, trajectory)
        ego_to_world = displaced(ego_to_world, ego_to_world, aside)
    rendered = []
    for frame, camera_pose, pose_of_ego in zip(frames, camera_to_world, ego_to_world, strict=True):
        size = target_size(frame, job.images if job.width is None else ImageSettings(width=job.width))
        intrinsics = continuous_intrinsics(frame, size)
        intrinsics[:2, 2] -= 0.5
        moved = replace(
            frame,
            image_path=str(folder / "images" / camera / f"{frame.timestamp}{IMAGE_SUFFIX}"),
            width=size[0],
            height=size[1],
            intrinsics=intrinsics,
            camera_to_world=camera_pose,
            ego_to_world=pose_of_ego,
        )
        rendered.append(moved)
    return rendered


def _tracks(scene: Scene, objects: Sequence[EditedActor], times: np.ndarray) -> tuple[Track, ...]:
    """The objects where they are present at `times` (n,) in microseconds. How visible they are is not known."""
    seconds, tracks = np.array([scene.seconds(time) for time in times]), []
    for item in objects:
        present = item.present(seconds)
        if not present.any():
            continue
        tracks.append(
            Track(
                id=item.id,
                object_class=item.object_class,
                category=item.category,
                size=item.size,
                timestamps=times[present],
                sample_indices=np.flatnonzero(present),
                object_to_world=item.poses(seconds[present]),
                visibility=np.zeros(int(present.sum()), dtype=np.int64),
            )
        )
    return tuple(tracks)


def _seconds(scene: Scene, frames: Sequence[Frame]) -> np.ndarray:
    """The times (n,) of images in seconds since the first image of a scene."""
    return np.array([scene.seconds(frame.timestamp) for frame in frames])
