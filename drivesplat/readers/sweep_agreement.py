"""What sweeps say against each other, in sentences: the height and tilt of the ground, and the places of surfaces.
These are warnings about poses."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from drivesplat.readers.sampled_sweeps import SampledSweep
from drivesplat.scene.scene import Sweep

RING = 3.0, 25.0
"""Between these horizontal distances in metres from a LiDAR, its returns are compared."""
CELL, LOW_PERCENT, MIN_RETURNS = 1.0, 10, 3
"""The side of a horizontal cell in metres, the percentile of its heights that is the ground, and the returns in it."""
MIN_CELLS = 50
"""Cells of two sweeps from which on their ground is compared."""
SAME, ROUNDS = 0.05, 12
"""Metres beyond which a cell loses weight, and rounds of reweighting."""
MAX_RATE, MIN_STEP = 0.12, 0.04
"""Metres a second, and metres, by which the height of the ground may differ between sweeps."""
MAX_TILT = 0.3
"""Degrees by which the tilt of the ground may differ between sweeps."""
UPRIGHT, SURFACE_POINTS = 0.7, 3000
"""Metres above the ground of its cell from which on a return is one of a surface, and how many are compared."""
MAX_DISTANCE = 0.4
"""Metres between a surface and the same one in another sweep (median)."""
MIN_PAIRS = 2


class _Pair(NamedTuple):
    """What differs between two sweeps `seconds` apart: `height` in metres and `tilt` in degrees of the ground, and the
    `distance` in metres between surfaces (median)."""

    seconds: float
    height: float
    tilt: float
    distance: float


class _Ground(NamedTuple):
    """The returns `points` (n, 3) of a sweep within RING, the number of the horizontal cell `cells` (n,) of each; the
    `known` cells (k,) in order, and the `lowest` returns (k, 3), a low one in each."""

    points: np.ndarray
    cells: np.ndarray
    known: np.ndarray
    lowest: np.ndarray


def agreement_warnings(sweeps: list[SampledSweep]) -> list[str]:
    """Sentences about sweeps that disagree on the ground or on surfaces. `sweeps` are in the world."""
    ordered = sorted(sweeps, key=lambda sampled: (sampled.sweep.lidar, sampled.sweep.timestamp))
    pairs = [
        found
        for one, other in pairwise(ordered)
        if one.sweep.lidar == other.sweep.lidar and (found := _compared(one, other)) is not None
    ]
    if len(pairs) < MIN_PAIRS:
        return []
    seconds, heights, tilts, distances = np.array(pairs).T
    nearby = seconds <= np.median(seconds)
    height, rate = np.median(np.abs(heights)), np.median(np.abs(heights) / seconds)
    tilt, distance = np.median(tilts), np.median(distances[nearby])
    if distance > MAX_DISTANCE:
        return [
            f"sweeps {np.median(seconds[nearby]):.1f} s apart lie {distance:.2f} m from each other on upright surfaces "
            "(median): check the unit and times of ego_poses, the rotations of poses, and the unit of sweeps"
        ]
    if rate > MAX_RATE and height > MIN_STEP:
        return [
            f"sweeps disagree on the height of the ground by {rate:.2f} m per second (median of {len(pairs)} pairs): z "
            "of ego poses drifts, or is not the height of the road"
        ]
    if tilt > MAX_TILT:
        return [
            f"sweeps disagree on the tilt of the ground by {tilt:.1f} degrees (median of {len(pairs)} pairs): roll or "
            "pitch of ego poses is missing or wrong, or their times are; refine_poses may "
            "mend it (docs/poses.md)"
        ]
    return []


def _compared(one: SampledSweep, other: SampledSweep) -> _Pair | None:
    """What differs between two sweeps; None where they have too little ground in common."""
    grounds = [_ground(sampled) for sampled in (one, other)]
    _, mine, theirs = np.intersect1d(grounds[0].known, grounds[1].known, return_indices=True)
    if len(mine) < MIN_CELLS:
        return None
    here, there = grounds[0].lowest[mine], grounds[1].lowest[theirs]
    middle = (_place(one.sweep) + _place(other.sweep)) / 2
    design = np.column_stack([np.ones(len(here)), here[:, :2] - middle])
    differences, weights = there[:, 2] - here[:, 2], np.ones(len(here))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        fitted = np.linalg.lstsq(design * root[:, None], differences * root, rcond=None)[0]
        weights = np.square(np.minimum(1.0, SAME / np.maximum(np.abs(design @ fitted - differences), 1e-9)))
    surfaces = []
    for points, cells, known, lowest in grounds:
        rows = np.minimum(np.searchsorted(known, cells), len(known) - 1)
        surfaces.append(points[(known[rows] == cells) & (points[:, 2] - lowest[rows, 2] > UPRIGHT)])
    if not all(map(len, surfaces)):
        return None
    distances, _ = cKDTree(surfaces[1]).query(surfaces[0][:: 1 + len(surfaces[0]) // SURFACE_POINTS])
    return _Pair(
        (other.sweep.timestamp - one.sweep.timestamp) * 1e-6,
        float(fitted[0]),
        float(np.degrees(np.hypot(*fitted[1:]))),
        float(np.median(distances)),
    )


def _place(sweep: Sweep) -> np.ndarray:
    return sweep.sensor_to_world[:2, 3]


def _ground(sampled: SampledSweep) -> _Ground:
    distances = np.linalg.norm(sampled.points[:, :2] - _place(sampled.sweep), axis=1)
    points = sampled.points[(distances > RING[0]) & (distances < RING[1])]
    columns = np.floor(points[:, :2] / CELL).astype(np.int64)
    cells = columns[:, 0] * (1 << 32) + columns[:, 1]
    order = np.lexsort((points[:, 2], cells))
    found, starts, counts = np.unique(cells[order], return_index=True, return_counts=True)
    enough = counts >= MIN_RETURNS
    lowest = points[order[(starts + counts * LOW_PERCENT // 100)[enough]]]
    return _Ground(points, cells, found[enough], lowest)
