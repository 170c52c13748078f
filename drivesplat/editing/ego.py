"""From where an edited drive is watched: the camera's car beside its recorded way, faster or slower."""

from collections.abc import Callable

import numpy as np

from drivesplat.editing.easing import Onset
from drivesplat.editing.heading import beside_the_way
from drivesplat.errors import ConfigError
from drivesplat.rendering.trajectory import CameraPath, film_path, recorded_frames, smooth_poses
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.edit import Edit, Ego
from drivesplat.settings.render import TrajectorySettings

Seconds = Callable[[np.ndarray], np.ndarray]


def edited_camera_path(scene: Scene, camera: str, fps: int, edit: Edit, where: str) -> CameraPath:
    """Where an edited film is looked at from, `fps` frames a second.

    The world runs at its own time, which `timestamps` are of. A car that is faster comes to the end of its recorded way
    earlier: there the film ends. Without `ego` steps it is the recorded path. Raises ConfigError, beginning with
    `where` (the scene and the edit), for a step that begins after the film, DatasetError where the scene does not hold
    that camera.
    """
    path = film_path(scene, camera, fps, TrajectorySettings())
    steps = [step.ego for step in edit.steps if step.ego is not None]
    if not steps:
        return path
    frames = recorded_frames(scene, camera)
    first, last = frames[0].timestamp, scene.seconds(frames[-1].timestamp)
    for number, step in enumerate(edit.steps, start=1):
        if step.ego is not None and (step.ego.start or 0.0) >= last:
            raise ConfigError(f"{where}, step {number} (ego): the drive ends before 'start': at {last:.2f} s")
    begin = scene.seconds(first)
    at = begin + (path.timestamps - first) * 1e-6
    clock = _clock(steps, begin)
    there = clock(at) <= last + 1e-9
    return CameraPath(path.timestamps[there], _cameras(frames, begin, clock, steps, at[there]))


def _clock(steps: list[Ego], begin: float) -> Seconds:
    """Which second of its way (n,) the car is at, at the seconds (n,) of the film."""

    def clock(at: np.ndarray) -> np.ndarray:
        for step in reversed(steps):
            at = Onset.of(step, begin).paced(at, step.speed)
        return at

    return clock


def _cameras(frames: list[Frame], begin: float, clock: Seconds, steps: list[Ego], at: np.ndarray) -> np.ndarray:
    """Camera to world (n, 4, 4) at the seconds `at` (n,). `begin`: the second of the first of `frames`."""
    recorded = np.array([frame.timestamp - frames[0].timestamp for frame in frames])
    ego_to_world = np.stack([frame.ego_to_world for frame in frames])
    camera_to_world = np.stack([frame.camera_to_world for frame in frames])

    def along(poses: np.ndarray) -> Seconds:
        return lambda at: smooth_poses(recorded, poses, (clock(at) - begin) * 1e6)

    onsets = [Onset.of(step, -np.inf) for step in steps]
    lateral = sum(step.lateral * onset.share(at) for step, onset in zip(steps, onsets, strict=True))
    drift = sum(step.lateral * onset.rate(at) for step, onset in zip(steps, onsets, strict=True))
    car, camera = along(ego_to_world), along(camera_to_world)
    return beside_the_way(car, at, lateral, drift) @ inverse(car(at)) @ camera(at)
