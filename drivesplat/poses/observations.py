"""Which images see which points."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Observations:
    """Where points are seen: per observation the `image` (o,) (position in the order of numbers), the `point` (o,)
    (position in `positions` (p, 3), world metres; pycolmap's number in `numbers` (p,)), and the reprojection `error`
    (o,) in pixels; infinite where the point lies behind the camera."""

    image: np.ndarray
    point: np.ndarray
    error: np.ndarray
    positions: np.ndarray
    numbers: np.ndarray

    def of_points(self, numbers: np.ndarray) -> np.ndarray:
        """Which observations (o,) bool are of points of these numbers."""
        return np.isin(self.numbers[self.point], numbers)
