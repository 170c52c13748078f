"""The path of the ego vehicle and its cameras in an edited drive: offset from the recorded path, faster or slower."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.edit import Edit, Ego
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.camera_path import CameraPath, film_path, recorded_frames, smooth_path
from drivesplat.trajectories.ego_path import edited_poses, recorded_time
from drivesplat.trajectories.lateral_offset import PosesAt

MAX_LEAD = 0.1
"""Seconds by which the path of a camera is extrapolated before its first image: the cameras of a rig fire at different
times."""


@dataclass(frozen=True)
class EgoEdit:
    """The steps of an edit that change the ego vehicle's path. Its clock is that of the recording at the second
    `begin`, that of the first image of the evaluated camera."""

    scene: Scene
    steps: tuple[Ego, ...]
    begin: float

    @classmethod
    def of(cls, scene: Scene, camera: str, edit: Edit, where: str) -> "EgoEdit | None":
        """The `ego` steps of an edit; None if it has none.

        Raises ConfigError, starting with `where` (the scene and the edit), for a step that starts after the drive;
        DatasetError if the scene lacks the camera.
        """
        steps = tuple(step.ego for step in edit.steps if step.ego is not None)
        if not steps:
            return None
        frames = recorded_frames(scene, camera)
        begin, last = (scene.seconds(frames[i].timestamp) for i in (0, -1))
        for number, step in enumerate(edit.steps, start=1):
            if step.ego is not None and (step.ego.start or 0.0) >= last:
                raise ConfigError(
                    f"{where}, step {number} (ego): 'start' is not before the end of the drive ({last:.2f} s)"
                )
        return cls(scene, steps, begin)

    def within(self, frames: Sequence[Frame], times: np.ndarray, until: float = 0.0) -> np.ndarray:
        """Whether the vehicle at `times` (n,) in seconds is on the part of its path in which the camera that took
        `frames` recorded, or before it was there at the second `until`: (n,) bool."""
        clock = recorded_time(self.steps, self.begin, times)
        first, last = (self.scene.seconds(frames[i].timestamp) for i in (0, -1))
        return (clock >= first - MAX_LEAD) & (clock <= max(last, until) + 1e-9)

    def poses(self, frames: Sequence[Frame], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Camera to world and ego to world (n, 4, 4) at `times` (n,) in seconds, of the camera that took `frames`."""
        first = self.scene.seconds(frames[0].timestamp)
        recorded = np.array([frame.timestamp - frames[0].timestamp for frame in frames])
        ego_to_world = np.stack([frame.ego_to_world for frame in frames])
        camera_to_world = np.stack([frame.camera_to_world for frame in frames])

        def interpolated(poses: np.ndarray) -> PosesAt:
            path = smooth_path(recorded, poses)
            return lambda times: path((times - first) * 1e6)

        clock, ego = recorded_time(self.steps, self.begin, times), interpolated(ego_to_world)
        edited = edited_poses(ego, self.steps, self.begin, times)
        return edited @ inverse(ego(clock)) @ interpolated(camera_to_world)(clock), edited


def edited_camera_path(scene: Scene, camera: str, fps: int, edit: Edit, where: str) -> CameraPath:
    """The camera poses of an edited film at `fps` frames a second.

    `timestamps` are those of the scene, whose time is unaffected. The film of a faster ego vehicle ends where the
    recorded path ends. Without `ego` steps the result is the recorded path. Raises what `EgoEdit.of` raises.
    """
    path = film_path(scene, camera, fps, TrajectorySettings())
    change = EgoEdit.of(scene, camera, edit, where)
    if change is None:
        return path
    frames = recorded_frames(scene, camera)
    times = change.begin + (path.timestamps - frames[0].timestamp) * 1e-6
    within = change.within(frames, times)
    return CameraPath(path.timestamps[within], change.poses(frames, times[within])[0])
