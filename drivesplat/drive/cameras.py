"""Cameras that a drive is rendered with: recorded ones, and ones of the user."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from drivesplat.errors import DatasetError, RequestError
from drivesplat.model.view import View
from drivesplat.readers.checks import checked_intrinsics, checked_size, checked_transform

Matrix = np.ndarray | torch.Tensor | Sequence[Sequence[float]]
"""What a pose may be given as."""


@dataclass(frozen=True, eq=False)
class PoseableCamera:
    """A pinhole camera with a global shutter.

    `width` and `height` in pixels; `K` in continuous pixels, in which the centre of the first pixel is at (0.5, 0.5).
    `camera_to_ego` is its mount on the ego vehicle (ego: x forward, y left, z up; camera: x right, y down, z forward),
    None for a camera that is always placed by its own pose. With `exposure_of`, images have the exposure that was
    learned for this recorded camera; otherwise the model's own colours, as films have. Raises RequestError for
    an invalid size, invalid intrinsics or an invalid mount.

    >>> PoseableCamera.from_fov(640, 360, 90.0).K.tolist()
    [[320.0, 0.0, 320.0], [0.0, 320.0, 180.0], [0.0, 0.0, 1.0]]
    """

    width: int
    height: int
    K: Float64[np.ndarray, "3 3"]
    camera_to_ego: Float64[np.ndarray, "4 4"] | None = None
    exposure_of: str | None = None

    def __post_init__(self) -> None:
        try:
            checked_size(self.width, self.height, "the camera")
        except DatasetError as error:
            raise RequestError(str(error)) from None
        object.__setattr__(self, "K", _checked(checked_intrinsics, self.K, "the camera"))
        if self.camera_to_ego is not None:
            object.__setattr__(self, "camera_to_ego", require_pose(self.camera_to_ego, "the camera's mount"))

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

    def resized(self, width: int) -> "PoseableCamera":
        """The same field of view in images of another width."""
        height = max(1, round(self.height * width / self.width))
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        return replace(self, width=width, height=height, K=self.K * scale)

    def view(self, camera_to_world: np.ndarray, time: float, device: torch.device) -> View:
        """The camera at a pose (4, 4) and a time in seconds since the first image."""
        pose, K = (torch.from_numpy(matrix).float().to(device) for matrix in (camera_to_world, self.K))
        return View(K, pose, self.width, self.height, time, camera=self.exposure_of)


def require_pose(pose: Matrix, of: str) -> Float64[np.ndarray, "4 4"]:
    """A pose as an array. Raises RequestError, which names what it is the pose `of`, unless it is a matrix (4, 4) of a
    rotation and a translation."""
    return _checked(checked_transform, pose, of)


def _checked(check: Callable[[Any, str], np.ndarray], matrix: Matrix, of: str) -> np.ndarray:
    try:
        values = matrix.detach().cpu().numpy() if isinstance(matrix, torch.Tensor) else np.asarray(matrix)
        return check(values.astype(np.float64) if values.dtype.kind in "fiu" else values, of)
    except (DatasetError, ValueError) as error:  # NumPy's for rows of different lengths
        raise RequestError(str(error) if isinstance(error, DatasetError) else f"{of}: {error}") from None
