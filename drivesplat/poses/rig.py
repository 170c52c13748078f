"""A scene's images as pycolmap knows them: cameras with fixed intrinsics on one rig, the own car; a pose per image.

The cameras of a key frame fire at different times, up to 0.8 m of driving apart, so each image is a moment of its own:
a frame of the rig in which one of its cameras took a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from drivesplat.errors import DatasetError
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene

CAR = pycolmap.sensor_t(pycolmap.SensorType.IMU, 1)
"""The rig's own frame: ego."""
_RIG = 1
_SAME_MOUNT = 1e-3
"""Metres and radians by which a camera's mount may differ from image to image."""


@dataclass(frozen=True)
class RigImages:
    """Images `indices` (of `scene.frames`) in the order of their times; image i is i + 1 to pycolmap. `cameras` are
    their cameras' names, camera c is c + 1 there. `own_car` says where they see its body."""

    scene: Scene
    indices: tuple[int, ...]
    cameras: tuple[str, ...]
    ego_mask: EgoMask = NO_EGO_MASK

    @classmethod
    def of(cls, scene: Scene, indices: Sequence[int], ego_mask: EgoMask = NO_EGO_MASK) -> "RigImages":
        ordered = tuple(sorted(indices, key=lambda i: (scene.frames[i].timestamp, scene.frames[i].camera)))
        return cls(scene, ordered, tuple(dict.fromkeys(scene.frames[i].camera for i in ordered)), ego_mask)

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def frames(self) -> list[Frame]:
        return [self.scene.frames[i] for i in self.indices]

    @property
    def seconds(self) -> np.ndarray:
        """(n,)."""
        return np.array([self.scene.seconds(frame.timestamp) for frame in self.frames])

    @property
    def timestamps(self) -> np.ndarray:
        """(n,), microseconds."""
        return np.array([frame.timestamp for frame in self.frames], dtype=np.int64)

    def camera_id(self, frame: Frame) -> int:
        return self.cameras.index(frame.camera) + 1

    def first_of(self, camera: str) -> Frame:
        return next(frame for frame in self.frames if frame.camera == camera)

    def rig(self) -> pycolmap.Rig:
        """The own car with its cameras. Raises DatasetError where a camera is not mounted rigidly."""
        rig = pycolmap.Rig(rig_id=_RIG)
        rig.add_ref_sensor(CAR)
        for camera in self.cameras:
            mounts = np.stack([_mount(frame) for frame in self.frames if frame.camera == camera])
            if np.abs(mounts - mounts[0]).max() > _SAME_MOUNT:
                raise DatasetError(f"scene {self.scene.name}: {camera} moves on the car, poses cannot be refined")
            rig.add_sensor(sensor(self.cameras.index(camera) + 1), to_pycolmap(mounts[0]))
        return rig

    def pycolmap_cameras(self) -> list[pycolmap.Camera]:
        """The cameras, at the size of the recorded images. Raises DatasetError where one changes within the drive."""
        cameras = []
        for number, name in enumerate(self.cameras, start=1):
            frame = self.first_of(name)
            size = (frame.width, frame.height)
            k = continuous_intrinsics(frame, size)
            for other in self.frames:
                if other.camera == name and np.abs(continuous_intrinsics(other, size) - k).max() > _SAME_MOUNT:
                    raise DatasetError(f"scene {self.scene.name}: the intrinsics of {name} change within the drive")
            cameras.append(
                pycolmap.Camera(
                    camera_id=number,
                    model="PINHOLE",
                    width=frame.width,
                    height=frame.height,
                    params=[k[0, 0], k[1, 1], k[0, 2], k[1, 2]],
                    has_prior_focal_length=True,
                )
            )
        return cameras

    def moment(self, number: int) -> pycolmap.Frame:
        """Image `number` (counted from 1) as a frame of the rig, its pose as given."""
        frame = self.frames[number - 1]
        moment = pycolmap.Frame(frame_id=number, rig_id=_RIG)
        moment.add_data_id(pycolmap.data_t(sensor(self.camera_id(frame)), number))
        moment.rig_from_world = to_pycolmap(inverse(frame.ego_to_world))
        return moment

    def key_frames(self) -> dict[str, dict[int, int]]:
        """By camera: the images' numbers (counted from 1) by their key frame."""
        numbers: dict[str, dict[int, int]] = {camera: {} for camera in self.cameras}
        for number, frame in enumerate(self.frames, start=1):
            numbers[frame.camera][frame.sample_index] = number
        return numbers


def sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def to_pycolmap(transform: np.ndarray) -> pycolmap.Rigid3d:
    """A rigid transform (4, 4) as pycolmap's."""
    return pycolmap.Rigid3d(np.ascontiguousarray(transform[:3]))


def from_pycolmap(transform: pycolmap.Rigid3d) -> np.ndarray:
    """pycolmap's rigid transform as a matrix (4, 4)."""
    return np.vstack([transform.matrix(), [0.0, 0.0, 0.0, 1.0]])


def _mount(frame: Frame) -> np.ndarray:
    """Ego to camera (4, 4)."""
    return inverse(frame.camera_to_world) @ frame.ego_to_world
