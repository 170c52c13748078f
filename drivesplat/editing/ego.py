"""The camera path of an edited drive: the ego vehicle offset from its recorded path, faster or slower."""

import numpy as np

from drivesplat.edited_motion.ego_path import edited_poses, recorded_time
from drivesplat.edited_motion.lateral_offset import PosesAt
from drivesplat.errors import ConfigError
from drivesplat.rendering.trajectory import CameraPath, film_path, recorded_frames, smooth_poses
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.edit import Edit, Ego
from drivesplat.settings.render import TrajectorySettings


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
    recorded = recorded_time(steps, begin, times) <= last + 1e-9
    return CameraPath(path.timestamps[recorded], _camera_poses(frames, begin, steps, times[recorded]))


def _camera_poses(frames: list[Frame], begin: float, steps: list[Ego], times: np.ndarray) -> np.ndarray:
    """Camera to world (n, 4, 4) at `times` (n,) in seconds; `begin` is the time of the first of `frames`."""
    recorded = np.array([frame.timestamp - frames[0].timestamp for frame in frames])
    ego_to_world = np.stack([frame.ego_to_world for frame in frames])
    camera_to_world = np.stack([frame.camera_to_world for frame in frames])

    def interpolated(poses: np.ndarray) -> PosesAt:
        return lambda times: smooth_poses(recorded, poses, (times - begin) * 1e6)

    clock = recorded_time(steps, begin, times)
    ego, camera = interpolated(ego_to_world)(clock), interpolated(camera_to_world)(clock)
    return edited_poses(interpolated(ego_to_world), steps, begin, times) @ inverse(ego) @ camera
