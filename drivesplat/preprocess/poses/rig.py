"""A scene's images in pycolmap's terms: one rig, the ego vehicle, of cameras with fixed intrinsics; a pose per image.

The cameras of a key frame trigger at different times, up to 0.8 m of driving apart, so each image is a frame of the rig
of its own, with data of one camera.
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

EGO = pycolmap.sensor_t(pycolmap.SensorType.IMU, 1)
"""The reference sensor of the rig: the ego frame."""
_RIG = 1
_CALIBRATION_TOLERANCE = 1e-3
"""Maximum change of mounts (metres, radians) and intrinsics (pixels) within a drive."""


@dataclass(frozen=True)
class RigImages:
    """Images with `indices` in `scene.frames`, ordered by time. pycolmap's numbers start at 1: image i has number i +
    1, and camera c of `cameras`, their names, c + 1. `ego_mask`: pixels of the ego vehicle."""

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
    def ego_to_world(self) -> np.ndarray:
        """Poses (n, 4, 4) in the scene."""
        return np.stack([frame.ego_to_world for frame in self.frames])

    @property
    def seconds(self) -> np.ndarray:
        """Times (n,) in the scene's seconds."""
        return np.array([self.scene.seconds(frame.timestamp) for frame in self.frames])

    @property
    def timestamps(self) -> np.ndarray:
        """Times (n,) in microseconds."""
        return np.array([frame.timestamp for frame in self.frames], dtype=np.int64)

    def camera_id(self, frame: Frame) -> int:
        return self.cameras.index(frame.camera) + 1

    def of_camera(self, camera: str) -> list[Frame]:
        return [frame for frame in self.frames if frame.camera == camera]

    def rig(self) -> pycolmap.Rig:
        """The ego vehicle with its cameras. Raises DatasetError where the mount of a camera changes."""
        rig = pycolmap.Rig(rig_id=_RIG)
        rig.add_ref_sensor(EGO)
        for number, camera in enumerate(self.cameras, start=1):
            mounts = np.stack([ego_to_camera(frame) for frame in self.of_camera(camera)])
            self._require_constant(mounts, f"{camera} moves on the car, poses cannot be refined")
            rig.add_sensor(sensor(number), to_pycolmap(mounts[0]))
        return rig

    def pycolmap_cameras(self) -> list[pycolmap.Camera]:
        """The cameras at the size of recorded images. Raises DatasetError where intrinsics change within the drive."""
        cameras = []
        for number, name in enumerate(self.cameras, start=1):
            frames = self.of_camera(name)
            width, height = frames[0].width, frames[0].height
            intrinsics = np.stack([continuous_intrinsics(frame, (width, height)) for frame in frames])
            self._require_constant(intrinsics, f"the intrinsics of {name} change within the drive")
            k = intrinsics[0]
            camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=width, height=height)
            camera.params = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
            camera.has_prior_focal_length = True
            cameras.append(camera)
        return cameras

    def _require_constant(self, matrices: np.ndarray, message: str) -> None:
        if np.abs(matrices - matrices[0]).max() > _CALIBRATION_TOLERANCE:
            raise DatasetError(f"scene {self.scene.name}: {message}")

    def rig_frame(self, number: int) -> pycolmap.Frame:
        """Image `number` (from 1) as a frame of the rig with its given pose."""
        frame = self.frames[number - 1]
        rig_frame = pycolmap.Frame(frame_id=number, rig_id=_RIG)
        rig_frame.add_data_id(pycolmap.data_t(sensor(self.camera_id(frame)), number))
        rig_frame.rig_from_world = to_pycolmap(inverse(frame.ego_to_world))
        return rig_frame

    def key_frames(self) -> dict[str, dict[int, int]]:
        """By camera: image numbers (from 1) by key frame."""
        numbers: dict[str, dict[int, int]] = {camera: {} for camera in self.cameras}
        for number, frame in enumerate(self.frames, start=1):
            numbers[frame.camera][frame.sample_index] = number
        return numbers


def sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def to_pycolmap(transform: np.ndarray) -> pycolmap.Rigid3d:
    """A rigid transform (4, 4) in pycolmap's type."""
    return pycolmap.Rigid3d(np.ascontiguousarray(transform[:3]))


def from_pycolmap(transform: pycolmap.Rigid3d) -> np.ndarray:
    """A rigid transform of pycolmap as a matrix (4, 4)."""
    return np.vstack([transform.matrix(), [0.0, 0.0, 0.0, 1.0]])


def ego_to_camera(frame: Frame) -> np.ndarray:
    """The mount (4, 4) of a frame's camera."""
    return inverse(frame.camera_to_world) @ frame.ego_to_world
