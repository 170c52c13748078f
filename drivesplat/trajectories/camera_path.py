"""Paths of a film's camera: the smoothed recorded path, or an offset from it; and the intrinsics of a film.

Frames as in `drivesplat.scene.scene`: world metres, OpenCV cameras, ego x forward, y left, z up. Timestamps:
microseconds.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from drivesplat.errors import DatasetError
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.lateral_offset import PosesAt


@dataclass(frozen=True)
class CameraPath:
    """A camera over time: `timestamps` (n,) int64, `camera_to_world` (n, 4, 4)."""

    timestamps: np.ndarray
    camera_to_world: np.ndarray

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, chosen: slice) -> "CameraPath":
        """A section of the path."""
        return CameraPath(self.timestamps[chosen], self.camera_to_world[chosen])


def film_path(scene: Scene, camera: str, fps: int, offset: TrajectorySettings) -> CameraPath:
    """The camera path of a film at `fps` frames a second and the speed of the drive, displaced by `offset`.

    It runs from the camera's first image to its last. Raises DatasetError where the scene does not hold that camera.
    """
    frames = recorded_frames(scene, camera)
    recorded = np.array([frame.timestamp for frame in frames], dtype=np.int64)
    timestamps = film_timestamps(frames[0].timestamp, frames[-1].timestamp, fps)
    camera_to_world = smooth_poses(recorded, np.stack([frame.camera_to_world for frame in frames]), timestamps)
    ego_to_world = smooth_poses(recorded, np.stack([frame.ego_to_world for frame in frames]), timestamps)
    return CameraPath(timestamps, displaced(camera_to_world, ego_to_world, offset))


def recorded_frames(scene: Scene, camera: str) -> list[Frame]:
    """A camera's images, key frames and others, at increasing times; of several with one time the first.

    Raises DatasetError where there are none.
    """
    by_time: dict[int, Frame] = {}
    for frame in scene.frames:
        if frame.camera == camera:
            by_time.setdefault(frame.timestamp, frame)
    if not by_time:
        cameras = ", ".join(dict.fromkeys(frame.camera for frame in scene.frames))
        raise DatasetError(
            f"scene {scene.name} has no image of camera {camera}; its cameras are {cameras or 'none'}: "
            "choose eval_camera among them, or add it to cameras"
        )
    return [by_time[timestamp] for timestamp in sorted(by_time)]


def recorded_timestamps(scene: Scene, camera: str) -> np.ndarray:
    """The timestamps (n,) of a camera's images in microseconds: int64, increasing."""
    return np.array([frame.timestamp for frame in recorded_frames(scene, camera)], dtype=np.int64)


def sampled_path(scene: Scene, camera: str, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """The timestamps (n,) of a camera's images and of `rate` times a second between them, and the poses (n, 4, 4) then.

    Images have their own poses; between them the path is that of films. Raises DatasetError if the camera has no
    images.
    """
    frames, recorded = recorded_frames(scene, camera), recorded_timestamps(scene, camera)
    times = np.union1d(recorded, film_timestamps(frames[0].timestamp, frames[-1].timestamp, rate))
    return times, smooth_poses(recorded, np.stack([frame.camera_to_world for frame in frames]), times)


def film_timestamps(first: int, last: int, fps: int) -> np.ndarray:
    """The times (n,) int64 of a film's frames: first + k / fps within [first, last], each rounded separately."""
    count = (last - first) * fps // 1_000_000 + 1
    elapsed = (2_000_000 * np.arange(count, dtype=np.int64) + fps) // (2 * fps)
    return first + elapsed


def smooth_poses(timestamps: np.ndarray, poses: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) at the times `wanted` (n,) of a motion through `poses` (m, 4, 4): see `smooth_path`."""
    return smooth_path(timestamps, poses)(wanted)


def smooth_path(timestamps: np.ndarray, poses: np.ndarray) -> PosesAt:
    """The motion through `poses` (m, 4, 4) at increasing `timestamps` (m,) in microseconds: a function that gives its
    poses (n, 4, 4) at times (n,), also in microseconds.

    Position and rotation are twice continuously differentiable, so that speed and turn rate are continuous.
    """
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    if len(poses) == 1:
        return lambda wanted: np.tile(rigid(rotations.as_matrix(), poses[:, :3, 3]), (len(wanted), 1, 1))
    # seconds since the first pose: polynomials in microseconds since 1970 lose all precision
    known = (timestamps - timestamps[0]) * 1e-6
    turning, moving = RotationSpline(known, rotations), CubicSpline(known, poses[:, :3, 3])

    def at(wanted: np.ndarray) -> np.ndarray:
        seconds = (wanted - timestamps[0]) * 1e-6
        return rigid(turning(seconds).as_matrix(), moving(seconds))

    return at


def displaced(camera_to_world: np.ndarray, ego_to_world: np.ndarray, offset: TrajectorySettings) -> np.ndarray:
    """Cameras (n, 4, 4) moved by `offset` along and about the axes of the ego vehicle (n, 4, 4)."""
    left, up = ego_to_world[:, :3, 1], ego_to_world[:, :3, 2]
    yaw = Rotation.from_rotvec(math.radians(offset.yaw) * up).as_matrix()
    moved = camera_to_world.copy()
    moved[:, :3, :3] = yaw @ camera_to_world[:, :3, :3]
    moved[:, :3, 3] += offset.lateral * left + offset.vertical * up
    return moved


def film_intrinsics(frame: Frame, width: int, height: int, horizontal_fov: float | None) -> np.ndarray:
    """K (3, 3), continuous pixels, of a film of `width` x `height` pixels by the camera of `frame`.

    Scales the recorded image about its centre to the width of the film, or to a horizontal field of view of
    `horizontal_fov` degrees. With another aspect ratio the film is padded or cropped at top and bottom.
    """
    k = continuous_intrinsics(frame, (frame.width, frame.height))
    scale = width / frame.width
    if horizontal_fov is not None:
        scale = width / 2 / math.tan(math.radians(horizontal_fov) / 2) / k[0, 0]
    k[:2, 2] -= np.array([frame.width, frame.height]) / 2
    k[:2] *= scale
    k[:2, 2] += np.array([width, height]) / 2
    return k
