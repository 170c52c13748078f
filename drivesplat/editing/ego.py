"""The camera path of an edited drive: the ego vehicle offset from its recorded path, faster or slower."""

from collections.abc import Callable

import numpy as np

from drivesplat.editing.lateral_offset import PosesAt, offset_poses
from drivesplat.editing.transition import Transition
from drivesplat.errors import ConfigError
from drivesplat.rendering.trajectory import CameraPath, film_path, recorded_frames, smooth_poses
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.edit import Edit, Ego
from drivesplat.settings.render import TrajectorySettings

Clock = Callable[[np.ndarray], np.ndarray]
"""Maps film seconds (n,) to seconds (n,) of the recorded path."""


def edited_camera_path(scene: Scene, camera: str, fps: int, edit: Edit, where: str) -> CameraPath:
    """The camera poses of an edited film at `fps` frames a second.

    `timestamps` are those of the scene, whose time is unaffected. The film of a faster ego vehicle ends where the
    recorded path ends. Without `ego` steps the result is the recorded path. Raises ConfigError, starting with `where`
    (the scene and the edit), for a step that starts after the film; DatasetError if the scene lacks the camera.
    """
    path = film_path(scene, camera, fps, TrajectorySettings())
    steps = [step.ego for step in edit.steps if step.ego is not None]
    if not steps:
        return path
    frames = recorded_frames(scene, camera)
    first, last = frames[0].timestamp, scene.seconds(frames[-1].timestamp)
    for number, step in enumerate(edit.steps, start=1):
        if step.ego is not None and (step.ego.start or 0.0) >= last:
            raise ConfigError(
                f"{where}, step {number} (ego): 'start' is not before the end of the drive ({last:.2f} s)"
            )
    begin = scene.seconds(first)
    times = begin + (path.timestamps - first) * 1e-6
    clock = _clock(steps, begin)
    recorded = clock(times) <= last + 1e-9
    return CameraPath(path.timestamps[recorded], _camera_poses(frames, begin, clock, steps, times[recorded]))


def _clock(steps: list[Ego], begin: float) -> Clock:
    def clock(times: np.ndarray) -> np.ndarray:
        for step in reversed(steps):
            times = Transition.of(step, begin).warp_time(times, step.speed)
        return times

    return clock


def _camera_poses(frames: list[Frame], begin: float, clock: Clock, steps: list[Ego], times: np.ndarray) -> np.ndarray:
    """Camera to world (n, 4, 4) at `times` (n,) in seconds; `begin` is the time of the first of `frames`."""
    recorded = np.array([frame.timestamp - frames[0].timestamp for frame in frames])
    ego_to_world = np.stack([frame.ego_to_world for frame in frames])
    camera_to_world = np.stack([frame.camera_to_world for frame in frames])

    def interpolated(poses: np.ndarray) -> PosesAt:
        return lambda times: smooth_poses(recorded, poses, (clock(times) - begin) * 1e6)

    transitions = [Transition.of(step, -np.inf) for step in steps]
    lateral = sum(step.lateral * t.fraction(times) for step, t in zip(steps, transitions, strict=True))
    lateral_speed = sum(step.lateral * t.rate(times) for step, t in zip(steps, transitions, strict=True))
    ego, camera = interpolated(ego_to_world), interpolated(camera_to_world)
    return offset_poses(ego, times, lateral, lateral_speed) @ inverse(ego(times)) @ camera(times)
