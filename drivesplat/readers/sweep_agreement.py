"""What sweeps say against each other, in sentences: the height and tilt of the ground, and the places of surfaces.
These are warnings about poses."""

from collections.abc import Iterator
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


def agreement_warnings(sweeps: list[SampledSweep]) -> list[str]:
    """Sentences about sweeps that disagree on the ground or on surfaces. `sweeps` are in the world."""
    ordered = sorted(sweeps, key=lambda sampled: (sampled.sweep.lidar, sampled.sweep.timestamp))
    pairs = [
        found
        for one, other in pairwise(ordered)
        if one.sweep.lidar == other.sweep.lidar and (found := _compared(one, other)) is not None
    ]
    return list(_disagreements(pairs)) if len(pairs) >= MIN_PAIRS else []


def _disagreements(pairs: list[_Pair]) -> Iterator[str]:
    seconds, heights, tilts, distances = np.array(pairs).T
    nearby = seconds <= np.median(seconds)
    height, rate = np.median(np.abs(heights)), np.median(np.abs(heights) / seconds)
    tilt, distance = np.median(tilts), np.median(distances[nearby])
    if distance > MAX_DISTANCE:
        yield (
            f"sweeps {np.median(seconds[nearby]):.1f} s apart lie {distance:.2f} m from each other on upright surfaces "
            "(median): check the unit and times of ego_poses, the rotations of poses, and the unit of sweeps"
        )
    elif rate > MAX_RATE and height > MIN_STEP:
        yield (
            f"sweeps disagree on the height of the ground by {rate:.2f} m per second (median of {len(pairs)} pairs): z "
            "of ego poses drifts, or is not the height of the road"
        )
    elif tilt > MAX_TILT:
        yield (
            f"sweeps disagree on the tilt of the ground by {tilt:.1f} degrees (median of {len(pairs)} pairs): roll or "
            "pitch of ego poses is missing or wrong, or their times are; refine_poses may "
            "mend it (docs/poses.md)"
        )


def _compared(one: SampledSweep, other: SampledSweep) -> _Pair | None:
    """What differs between two sweeps; None where they have too little ground in common."""
    grounds = [_ground(sampled) for sampled in (one, other)]
    _, mine, theirs = np.intersect1d(grounds[0][0], grounds[1][0], return_indices=True)
    if len(mine) < MIN_CELLS:
        return None
    (here, there) = grounds[0][1][mine], grounds[1][1][theirs]
    middle = (_place(one.sweep) + _place(other.sweep)) / 2
    design = np.column_stack([np.ones(len(here)), here[:, :2] - middle])
    differences, weights = there[:, 2] - here[:, 2], np.ones(len(here))
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        fitted = np.linalg.lstsq(design * root[:, None], differences * root, rcond=None)[0]
        weights = np.square(np.minimum(1.0, SAME / np.maximum(np.abs(design @ fitted - differences), 1e-9)))
    surfaces = [_surfaces(sampled, ground) for sampled, ground in zip((one, other), grounds, strict=True)]
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


def _near(sampled: SampledSweep) -> np.ndarray:
    """The returns (n, 3) within RING."""
    distances = np.linalg.norm(sampled.points[:, :2] - _place(sampled.sweep), axis=1)
    return sampled.points[(distances > RING[0]) & (distances < RING[1])]


def _cells(points: np.ndarray) -> np.ndarray:
    """A number (n,) for the horizontal cell of each point (n, 3)."""
    columns = np.floor(points[:, :2] / CELL).astype(np.int64)
    return columns[:, 0] * (1 << 32) + columns[:, 1]


def _ground(sampled: SampledSweep) -> tuple[np.ndarray, np.ndarray]:
    """The cells (k,) of a sweep in order, and a low return (k, 3) in each."""
    points = _near(sampled)
    cells = _cells(points)
    order = np.lexsort((points[:, 2], cells))
    found, starts, counts = np.unique(cells[order], return_index=True, return_counts=True)
    enough = counts >= MIN_RETURNS
    lowest = points[order[(starts + counts * LOW_PERCENT // 100)[enough]]]
    return found[enough], lowest


def _surfaces(sampled: SampledSweep, ground: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The returns (n, 3) of a sweep that lie UPRIGHT above the ground."""
    points, (known, lowest) = _near(sampled), ground
    if not len(known):
        return points[:0]
    cells = _cells(points)
    rows = np.minimum(np.searchsorted(known, cells), len(known) - 1)
    return points[(known[rows] == cells) & (points[:, 2] - lowest[rows, 2] > UPRIGHT)]
