"""Which LiDAR returns an image sees, where returns are far sparser than pixels.

LiDAR stands elsewhere than the camera: it looks over a car at what that car hides from the camera, and such a return
falls between those of the car. So a return stands for the patch of surface around it, as wide as the rays there lie
apart; in the image that is a window, which grows with its nearness.
"""

from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import kernel
from drivesplat.lidar.coloring import hidden_behind


def patches(
    ranges: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, ray_spacing: tuple[float, float]
) -> np.ndarray:
    """Half the width and half the height (m, 2), in pixels, of the windows of returns at `ranges` (m,) from the LiDAR
    and `depth` (m,) before the camera, metres. `intrinsics` (3, 3); `ray_spacing` in azimuth and elevation, degrees."""
    apart = ranges[:, None] * np.radians(ray_spacing)
    return 0.5 * apart * intrinsics.diagonal()[:2] / depth[:, None]


def unhidden(
    rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, halves: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Which returns (m,) bool, at `depth` metres in pixels (`rows`, `columns`) of an image of `shape` (h, w), no other
    stands clearly before, in its window of `halves` (m, 2): half its width and height in pixels."""
    nearest = np.full(shape, np.inf)
    _lay_down(nearest, rows, columns, depth, np.round(halves).astype(np.int64))
    return ~hidden_behind(depth, nearest[rows, columns])


@kernel
@no_type_check
def _lay_down(nearest, rows, columns, depth, halves):
    """Brings `nearest` (h, w) down to the depths of windows around pixels."""
    height, width = nearest.shape
    for i in range(len(rows)):
        for row in range(max(0, rows[i] - halves[i, 1]), min(height, rows[i] + halves[i, 1] + 1)):
            for column in range(max(0, columns[i] - halves[i, 0]), min(width, columns[i] + halves[i, 0] + 1)):
                nearest[row, column] = min(nearest[row, column], depth[i])
