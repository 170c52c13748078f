"""Exact traversal of a voxel grid by rays.

Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987. Each crossing
is computed from the ray's start, and the number of crossings is known at the start: no error accumulates, and every ray
ends in the voxel of its end point.
"""

import math
from typing import no_type_check

import cv2
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


def empty_voxels(counts: np.ndarray, min_rays: int) -> np.ndarray:
    """The voxels off the border of `counts` (x, y, z) that at least `min_rays` rays passed, whose six face neighbours
    rays passed (one side of a surface is reached by no ray), and that have no occupied one among their 26 neighbours:
    ascending indices (k,) int64 into the flattened grid."""
    cross, square = (cv2.getStructuringElement(shape, (3, 3)) for shape in (cv2.MORPH_CROSS, cv2.MORPH_RECT))
    found = [np.empty(0, dtype=np.int64)]
    for x in range(1, len(counts) - 1):
        before, here, after = counts[x - 1 : x + 2]
        empty = (here >= min_rays) & (cv2.erode(here, cross) > 0) & (before > 0) & (after > 0)
        empty &= cv2.dilate(np.maximum(here, np.maximum(before, after)), square) < OCCUPIED
        empty[[0, -1]] = empty[:, [0, -1]] = False
        found.append(np.flatnonzero(empty) + x * empty.size)
    return np.concatenate(found)
