"""Exact traversal of a voxel grid by rays.

Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987. Each crossing
is computed from the ray's start, and the number of crossings is known at the start: no error accumulates, and every ray
ends in the voxel of its end point.
"""

import math
from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import callee, kernel

OCCUPIED = 255
"""Value of a voxel in which rays end; counts of passing rays saturate below it."""


@callee
@no_type_check
def _count(counts, cell):
    before = counts[cell[0], cell[1], cell[2]]
    if before < OCCUPIED - 1:
        counts[cell[0], cell[1], cell[2]] = before + 1


@callee
@no_type_check
def _next_crossing(start, along, cell, left):
    """The fraction of a ray at which it leaves `cell` on one axis; infinity if no cells are `left` to enter."""
    if left == 0:
        return math.inf
    return ((cell + 1 if along > 0 else cell) - start) / along


@kernel
@no_type_check
def count_passing(counts, starts, ends):
    """Adds to `counts` (x, y, z) uint8 the rays that touch each voxel.

    `starts` and `ends` (r, 3) in units of voxels, inside the grid.
    """
    cell, left, crossing = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for ray in range(len(starts)):
        steps = 0
        for axis in range(3):
            start, end = starts[ray, axis], ends[ray, axis]
            cell[axis] = math.floor(start)
            left[axis] = abs(math.floor(end) - cell[axis])
            crossing[axis] = _next_crossing(start, end - start, cell[axis], left[axis])
            steps += left[axis]
        _count(counts, cell)
        for _ in range(steps):
            axis = 0 if crossing[0] <= crossing[1] else 1
            if crossing[2] < crossing[axis]:
                axis = 2
            along = ends[ray, axis] - starts[ray, axis]
            cell[axis] += 1 if along > 0 else -1
            left[axis] -= 1
            crossing[axis] = _next_crossing(starts[ray, axis], along, cell[axis], left[axis])
            _count(counts, cell)


@callee
@no_type_check
def _inside(counts, x, y, z):
    """Whether rays passed all six face neighbours of a voxel: one side of a surface is reached by no ray."""
    return (
        counts[x - 1, y, z] > 0
        and counts[x + 1, y, z] > 0
        and counts[x, y - 1, z] > 0
        and counts[x, y + 1, z] > 0
        and counts[x, y, z - 1] > 0
        and counts[x, y, z + 1] > 0
    )


@callee
@no_type_check
def _clear(counts, x, y, z):
    """Whether a voxel and its 26 neighbours are all unoccupied."""
    for i in range(x - 1, x + 2):
        for j in range(y - 1, y + 2):
            for k in range(z - 1, z + 2):
                if counts[i, j, k] == OCCUPIED:
                    return False
    return True


@kernel
@no_type_check
def empty_voxels(counts, min_rays):
    """The voxels off the grid's border that at least `min_rays` rays passed, whose face neighbours rays passed, and
    that have no occupied neighbour: ascending indices (k,) int64 into the flattened grid."""
    nx, ny, nz = counts.shape
    found = np.empty(1024, np.int64)
    n = 0
    for x in range(1, nx - 1):
        for y in range(1, ny - 1):
            for z in range(1, nz - 1):
                if min_rays <= counts[x, y, z] < OCCUPIED and _inside(counts, x, y, z) and _clear(counts, x, y, z):
                    if n == len(found):
                        larger = np.empty(2 * n, np.int64)
                        larger[:n] = found
                        found = larger
                    found[n] = (x * ny + y) * nz + z
                    n += 1
    return found[:n].copy()
