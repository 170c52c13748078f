"""Cameras that a drive is rendered with: recorded ones, and ones of the user."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float64

from drivesplat.drive.lenses import BANDS, LensFace, faces_of
from drivesplat.errors import DatasetError, RequestError
from drivesplat.model.view import View, rolling_shutter_of
from drivesplat.readers.checks import checked_intrinsics, checked_size, checked_transform
from drivesplat.scene.ego_mask import Outline, enclosed
from drivesplat.scene.lens import POLYNOMIALS, coefficients_fault, lens_fault
from drivesplat.scene.sensors import Camera, DistortionModel
from drivesplat.scene.shutter import Shutter

Matrix = np.ndarray | torch.Tensor | Sequence[Sequence[float | int]]
"""What a pose may be given as."""
Vector = np.ndarray | torch.Tensor | Sequence[float | int]
"""What a velocity may be given as."""


@dataclass(frozen=True, eq=False)
class PoseableCamera:
    """A camera that can be placed anywhere.

    `width` and `height` in pixels; `K` in continuous pixels, in which the centre of the first pixel is at (0.5, 0.5).
    `camera_to_ego` is its mount on the ego vehicle (ego: x forward, y left, z up; camera: x right, y down, z forward),
    None for a camera that is always placed by its own pose. With `exposure_of`, images have the exposure that was
    learned for this recorded camera; otherwise that of films. Without a pose it is on the path of the recorded camera
    `path_of`, or else where its mount is on the vehicle.

    `readout_s` are the seconds from the left edge to the right one and from the top edge to the bottom one at which
    lines are read, negative if read the other way, and from the image's time to the middle of the readout; zeros: a
    global shutter. `distortion` are the coefficients of `distortion_model` (`drivesplat.scene.lens`), of whose
    polynomials K may shear the image; directions farther than `max_angle` radians from the optical axis have no pixel.
    `covered` are outlines, in fractions of width and height, of the vehicle's own body.

    Raises RequestError for an invalid size, lens or mount.

    >>> PoseableCamera.from_fov(640, 360, 90.0).K.tolist()
    [[320.0, 0.0, 320.0], [0.0, 320.0, 180.0], [0.0, 0.0, 1.0]]
    """

    width: int
    height: int
    K: Float64[np.ndarray, "3 3"]
    camera_to_ego: Float64[np.ndarray, "4 4"] | None = None
    exposure_of: str | None = None
    path_of: str | None = None
    readout_s: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    distortion: Float64[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0))
    distortion_model: DistortionModel = "none"
    max_angle: float | None = None
    covered: tuple[Outline, ...] = ()

    def __post_init__(self) -> None:
        try:
            width, height = checked_size(self.width, self.height, "the camera")
        except DatasetError as error:
            raise RequestError(str(error)) from None
        object.__setattr__(self, "width", width)
        object.__setattr__(self, "height", height)
        check = checked_sheared_intrinsics if self.distortion_model in POLYNOMIALS else checked_intrinsics
        object.__setattr__(self, "K", _checked(check, self.K, "the camera"))
        object.__setattr__(self, "readout_s", require_vector(self.readout_s, 3, "the camera's readout_s"))
        object.__setattr__(self, "distortion", require_vector(self.distortion, None, "the camera's distortion"))
        if self.camera_to_ego is not None:
            object.__setattr__(self, "camera_to_ego", require_pose(self.camera_to_ego, "the camera's mount"))
        if self.distortion_model not in get_args(DistortionModel):
            known = ", ".join(get_args(DistortionModel))
            raise RequestError(f"there is no distortion model {self.distortion_model!r}; there are: {known}")
        fault = coefficients_fault(self.distortion_model, len(self.distortion))
        if self.distorted:
            fault = fault or lens_fault(self.lens)
        elif self.max_angle is not None:
            fault = "max_angle is that of a lens: leave it out for a pinhole camera"
        if self.max_angle is not None and not 0.0 < self.max_angle <= math.pi:
            fault = f"a max_angle of {self.max_angle:g} is no angle in radians, above 0 and up to 3.14"
        if fault is not None:
            raise RequestError(f"the camera: {fault}")

    @classmethod
    def from_fov(
        cls, width: int, height: int, horizontal_fov: float, camera_to_ego: np.ndarray | None = None
    ) -> "PoseableCamera":
        """A camera with square pixels, its axis through the middle of the image, and this horizontal field of view in
        degrees."""
        if not 0.0 < horizontal_fov < 180.0:
            raise RequestError(f"a pinhole camera cannot have a field of view of {horizontal_fov:g} degrees")
        focal = width / 2 / math.tan(math.radians(horizontal_fov) / 2)
        K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return cls(width, height, K, camera_to_ego)

    @property
    def distorted(self) -> bool:
        """Whether it is no pinhole camera."""
        return self.distortion_model != "none"

    @property
    def lens(self) -> Camera:
        """The lens as scenes describe it: with integer coordinates at the centres of pixels."""
        shifted = self.K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        return Camera("", self.width, self.height, shifted, self.distortion, distortion_model=self.distortion_model)

    @cached_property
    def faces(self) -> list[LensFace]:
        """The pinhole images that a distorted image is resampled from."""
        faces = faces_of(self.lens, self.max_angle, self._bands)
        if not faces:
            raise RequestError("the camera: its lens images no direction within its image")
        return faces

    @property
    def _bands(self) -> tuple[int, int]:
        """The numbers of columns and rows of parts of a distorted image that are read at times of their own."""
        return BANDS if self.readout_s[0] else 1, BANDS if self.readout_s[1] else 1

    def resized(self, width: int) -> "PoseableCamera":
        """The same field of view in images of another width."""
        height = max(1, round(self.height * width / self.width))
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        if self.distortion_model in POLYNOMIALS:
            raise RequestError(f"distortion {self.distortion_model!r} is in pixels: its camera cannot be resized")
        return replace(self, width=width, height=height, K=self.K * scale)

    def uncovered(self) -> Bool[np.ndarray, "h w"]:
        """The pixels (h, w) that show more than the vehicle's own body."""
        return ~enclosed(self.covered, (self.width, self.height))


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera at a pose and a time in seconds since the first image. `velocity` (6,): linear (m/s), then angular
    velocity (rad/s) along the camera's own axes, which matter to a rolling shutter."""

    camera: PoseableCamera
    camera_to_world: Float64[np.ndarray, "4 4"]
    velocity: Float64[np.ndarray, "6"]
    time: float

    def view(self, device: torch.device) -> View:
        """What the model renders; without the distortion of the lens."""
        camera = self.camera
        pose, K = (torch.from_numpy(matrix).float().to(device) for matrix in (self.camera_to_world, camera.K))
        shutter = Shutter(camera.readout_s, self.velocity) if camera.readout_s.any() else None
        rolling = rolling_shutter_of(shutter, device)
        return View(K, pose, camera.width, camera.height, self.time, camera.exposure_of, rolling)


@dataclass(frozen=True, eq=False)
class GivenPose:
    """What a user gives of a sensor's pose at a time: `ego_to_world` (4, 4) of the vehicle that carries it, or its own
    `sensor_to_world`, and the `velocity` (6,) of what the pose is given for, or else of the vehicle, along its own
    axes. What is None is as in the drive; a given pose without a velocity rests."""

    ego_to_world: Float64[np.ndarray, "4 4"] | None = None
    sensor_to_world: Float64[np.ndarray, "4 4"] | None = None
    velocity: Float64[np.ndarray, "6"] | None = None

    @classmethod
    def checked(
        cls, sensor: str, ego_to_world: Matrix | None, sensor_to_world: Matrix | None, velocity: Vector | None
    ) -> "GivenPose":
        """Raises RequestError, which names the `sensor`, for two poses and for what is no pose or velocity."""
        if ego_to_world is not None and sensor_to_world is not None:
            raise RequestError(f"{sensor} has one pose: give that of the vehicle or its own, not both")
        return cls(
            None if ego_to_world is None else require_pose(ego_to_world, "the ego vehicle"),
            None if sensor_to_world is None else require_pose(sensor_to_world, sensor),
            None if velocity is None else require_vector(velocity, 6, "the velocity"),
        )

    @property
    def motion(self) -> Float64[np.ndarray, "6"]:
        """The velocity, zeros where none is given."""
        return np.zeros(6) if self.velocity is None else self.velocity


AS_DRIVEN = GivenPose()


def checked_sheared_intrinsics(matrix: np.ndarray, record: str) -> np.ndarray:
    """The K (3, 3) of a lens that may shear the image; otherwise as `checked_intrinsics`."""
    if matrix.shape != (3, 3) or matrix.dtype.kind != "f":
        return checked_intrinsics(matrix, record)
    shear, plain = matrix[[0, 1], [1, 0]], matrix.copy()
    plain[[0, 1], [1, 0]] = 0.0
    checked = checked_intrinsics(plain, record)
    checked[[0, 1], [1, 0]] = shear
    if not np.isfinite(shear).all() or np.linalg.det(checked) <= 0.0:
        raise DatasetError(f"{record}: its camera matrix is singular or mirrors the image")
    return checked


def require_pose(pose: Matrix, of: str) -> Float64[np.ndarray, "4 4"]:
    """A pose as an array. Raises RequestError, which names what it is the pose `of`, unless it is a matrix (4, 4) of a
    rotation and a translation."""
    return _checked(checked_transform, pose, of)


def require_vector(values: Vector, length: int | None, what: str) -> Float64[np.ndarray, " n"]:
    """Finite numbers, as many as `length` if that is not None, as an array. Raises RequestError that says `what` they
    are."""
    try:
        found = np.array(values.detach().cpu() if isinstance(values, torch.Tensor) else values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.full((1, 1), np.nan)
    if found.ndim != 1 or length not in (None, len(found)) or not np.isfinite(found).all():
        raise RequestError(f"{what} must be {'some' if length is None else length} finite numbers, not {values}")
    return found


def mounted_velocity(
    velocity: Float64[np.ndarray, "6"], sensor_to_ego: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "6"]:
    """The velocity of a sensor on a vehicle along its own axes, by that of the vehicle along its axes: linear (m/s),
    then angular (rad/s)."""
    turning = velocity[3:]
    moving = velocity[:3] + np.cross(turning, sensor_to_ego[:3, 3])
    return (np.stack([moving, turning]) @ sensor_to_ego[:3, :3]).reshape(6)


def _checked(check: Callable[[Any, str], np.ndarray], matrix: Matrix, of: str) -> np.ndarray:
    try:
        values = matrix.detach().cpu().numpy() if isinstance(matrix, torch.Tensor) else np.asarray(matrix)
        return check(values.astype(np.float64) if values.dtype.kind in "fiu" else values, of)
    except (DatasetError, ValueError) as error:  # NumPy's for rows of different lengths
        raise RequestError(str(error) if isinstance(error, DatasetError) else f"{of}: {error}") from None
