"""LiDARs on other paths than the recorded one: beside it, or wherever an edited ego vehicle carries them."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.lidar.moved_sensor import moved, sensor_poses_of
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.camera_path import displaced, recorded_frames, smooth_path

EgoPoses = Callable[[np.ndarray], np.ndarray]
"""Ego to world (n, 4, 4) at seconds (n,) since the scene's first image."""
MIN_TRAVEL = 1.0
"""Metres between two sweeps that show where ahead is, if nothing else says so."""


def recorded_ego(scene: Scene, camera: str | None) -> EgoPoses:
    """The ego poses by the images of a camera. Without a camera or images, by the scene's sweeps: their mounts, or the
    direction of travel. Raises DatasetError where nothing shows where ahead is, or the scene has images but not
    of that camera.
    """
    if camera is None or not scene.frames:
        seconds, poses = _ego_of_sweeps(scene)
    else:
        frames = recorded_frames(scene, camera)
        seconds = np.array([scene.seconds(frame.timestamp) for frame in frames])
        poses = np.stack([frame.ego_to_world for frame in frames])
    path = smooth_path(seconds * 1e6, poses)
    return lambda times: path(times * 1e6)


def _ego_of_sweeps(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (n,) and ego poses (n, 4, 4) of the sweeps of the first LiDAR of a scene without images."""
    sweeps = sorted((s for s in scene.sweeps if s.lidar == scene.sweeps[0].lidar), key=lambda sweep: sweep.timestamp)
    seconds = np.array([scene.seconds(sweep.timestamp) for sweep in sweeps])
    mounted = [s.sensor_to_world @ inverse(s.motion.sensor_to_ego) for s in sweeps if s.motion is not None]
    if len(mounted) == len(sweeps):
        return seconds, np.stack(mounted)
    places = np.stack([sweep.sensor_to_world[:3, 3] for sweep in sweeps])
    far = np.flatnonzero(np.linalg.norm(places - places[0], axis=1) >= MIN_TRAVEL)
    if not len(far):
        raise DatasetError(
            f"scene {scene.name} has no image, its LiDAR stands and has no mount: nothing says where left is; "
            "ask for the trajectory of the recorded path"
        )
    turns, ahead = [], (places[far[0]] - places[0])[:2]
    for i in range(len(places)):
        step = (places[min(i + 1, len(places) - 1)] - places[max(i - 1, 0)])[:2]
        ahead = step if np.linalg.norm(step) >= MIN_TRAVEL else ahead
        turns.append(np.arctan2(ahead[1], ahead[0]))
    return seconds, rigid(Rotation.from_euler("z", np.array(turns)[:, None]).as_matrix(), places)


def beside(recorded: RecordedScan, ego: EgoPoses, offset: TrajectorySettings) -> RecordedScan:
    """The scan's rays from a sensor displaced as cameras are (`drivesplat.trajectories.camera_path.displaced`)."""
    sensor = sensor_poses_of(recorded)
    return moved(recorded, lambda offsets: displaced(sensor(offsets), ego(recorded.seconds + offsets), offset))


def carried(recorded: RecordedScan, ego: EgoPoses, edited: EgoPoses) -> RecordedScan:
    """The scan's rays from a sensor on an ego vehicle that drives as `edited` says."""
    sensor = sensor_poses_of(recorded)

    def at(offsets: np.ndarray) -> np.ndarray:
        times = recorded.seconds + offsets
        return edited(times) @ inverse(ego(times)) @ sensor(offsets)

    return moved(recorded, at)
