"""Intersections of directions with a cube."""

from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba.threads import parallel_for

ROWS = 16
"""Rows of an image per chunk."""


def face_coordinates(rays: np.ndarray) -> np.ndarray:
    """`drivesplat.kernels.cube_map.face_coordinates` of directions (h, w, 3), in one pass."""
    coordinates = np.empty_like(rays)
    parallel_for(_face_coordinates, len(rays), ROWS, rays, coordinates)
    return coordinates


@kernel
@no_type_check
def _face_coordinates(start, stop, rays, coordinates):
    """Processes rows `start` to `stop` of directions."""
    for row in range(start, stop):
        for column in range(rays.shape[1]):
            ray = rays[row, column]
            axis = 0
            for other in (1, 2):
                if abs(ray[other]) > abs(ray[axis]):
                    axis = other
            along = abs(ray[axis])
            coordinates[row, column, 0] = ray[(axis + 1) % 3] / along
            coordinates[row, column, 1] = ray[(axis + 2) % 3] / along
            coordinates[row, column, 2] = (2 * axis + (ray[axis] < 0)) * (2.0 / 5.0) - 1.0
