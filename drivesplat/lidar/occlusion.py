"""The visibility of LiDAR returns in an image whose pixels are much denser than the returns.

The LiDAR may see, over a car, surfaces that the car hides from the camera; such a return projects between those of the
car. Each return therefore stands for a patch of surface as wide as the ray spacing at its range. The patch projects to
a window of pixels.
"""

from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import kernel
from drivesplat.lidar.coloring import hidden_behind


def patches(
    ranges: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, ray_spacing: tuple[float, float]
) -> np.ndarray:
    """Half widths and half heights (m, 2), in pixels, of the windows of returns at `ranges` (m,) from the LiDAR and
    `depth` (m,) from the camera, in metres. `intrinsics` (3, 3); `ray_spacing` in azimuth and elevation, in degrees."""
    spacing = ranges[:, None] * np.radians(ray_spacing)
    return 0.5 * spacing * intrinsics.diagonal()[:2] / depth[:, None]


def unoccluded(
    rows: np.ndarray, columns: np.ndarray, depth: np.ndarray, halves: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Whether returns at `depth` (m,) metres and pixels (`rows`, `columns`) of an image of `shape` (h, w) are not
    occluded by the window of another return: (m,) bool. `halves` (m, 2) are half widths and half heights in pixels."""
    nearest = np.full(shape, np.inf)
    _draw_windows(nearest, rows, columns, depth, np.round(halves).astype(np.int64))
    return ~hidden_behind(depth, nearest[rows, columns])


@kernel
@no_type_check
def _draw_windows(nearest, rows, columns, depth, halves):
    """Lowers `nearest` (h, w) to the smallest depth of the windows that cover each pixel."""
    height, width = nearest.shape
    for i in range(len(rows)):
        for row in range(max(0, rows[i] - halves[i, 1]), min(height, rows[i] + halves[i, 1] + 1)):
            for column in range(max(0, columns[i] - halves[i, 0]), min(width, columns[i] + halves[i, 0] + 1)):
                nearest[row, column] = min(nearest[row, column], depth[i])
