"""Rays of scans that say nothing about the scene: those that meet the ego vehicle, and those of skipped sectors. And
rays that the ego vehicle blocks, where a dataset has removed its returns."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from drivesplat.scene.scan import Scan

AZIMUTH_BINS = 360
"""Cells of azimuth in which the ego vehicle's returns are counted."""
MIN_SECTOR = np.radians(5.0)
"""Width of a sector without any return from which the sensor is taken to have skipped it."""

MIN_SCANS, MIN_PATH = 10, 5.0
"""Number of training scans, and metres that the sensor moves in a straight line between two of them, from which rays
that never return are taken to be blocked by the vehicle: what stands in the scene would have come into their way."""


def measured_rays(scans: Sequence[Scan], ego_radius: float) -> list[Bool[np.ndarray, "b a"]]:
    """Whether each ray of the scans of one LiDAR says something about the scene.

    Three kinds do not: rays whose return is within `ego_radius` metres (horizontally) of the sensor; holes of a beam
    that has such returns within the same degree of azimuth in more than half of the scans, and of the beams below it,
    which meet the ego vehicle too near to be measured; and all rays of a sector of MIN_SECTOR or more without a single
    return.
    """
    near = [scan.returned & (scan.ranges * np.cos(scan.rays.elevations) <= ego_radius) for scan in scans]
    beams = max((scan.rays.shape[0] for scan in scans), default=0)
    counts = np.zeros((beams, AZIMUTH_BINS), dtype=np.int64)
    for scan, close in zip(scans, near, strict=True):
        met = np.zeros_like(counts, dtype=bool)
        met[_cells(scan)[0][close], _cells(scan)[1][close]] = True
        counts += met
    often = counts > 0.5 * len(scans)
    found = []
    for scan, close in zip(scans, near, strict=True):
        downwards = np.argsort(-scan.rays.beam_elevations, kind="stable")
        met_from_above = np.empty((len(downwards), AZIMUTH_BINS), dtype=bool)
        met_from_above[downwards] = np.logical_or.accumulate(often[downwards], axis=0)
        found.append(~close & ~(~scan.returned & met_from_above[_cells(scan)]) & ~skipped(scan))
    return found


def blocked_rays(
    scans: Sequence[Scan], poses: Sequence[Float[np.ndarray, "4 4"]], training: Sequence[bool]
) -> list[Bool[np.ndarray, "b a"]]:
    """The rays of the scans of one LiDAR that the vehicle blocks: those below the horizontal, of beams of which at
    least half of the rays return, in a cell of one degree of azimuth that has no return in any scan of `training`.

    None is, with under MIN_SCANS training scans, or where these lie within MIN_PATH metres. Returns of other scans have
    no effect: what is blocked may be predicted for them.
    """
    chosen = [scan for scan, used in zip(scans, training, strict=True) if used]
    places = np.array([pose[:3, 3] for pose, used in zip(poses, training, strict=True) if used]).reshape(-1, 3)
    if len(chosen) < MIN_SCANS or np.linalg.norm(np.ptp(places, axis=0)) < MIN_PATH:
        return [np.zeros(scan.returned.shape, dtype=bool) for scan in scans]
    returns = np.zeros((max(scan.rays.shape[0] for scan in scans), AZIMUTH_BINS), dtype=np.int64)
    rays = np.zeros_like(returns)
    for scan in chosen:
        np.add.at(rays, _cells(scan), 1)
        np.add.at(returns, _cells(scan), scan.returned)
    mostly = returns.sum(axis=1) >= 0.5 * rays.sum(axis=1)
    empty = mostly[:, None] & (rays > 0) & (returns == 0)
    return [empty[_cells(scan)] & (scan.rays.beam_elevations < 0)[:, None] for scan in scans]


def skipped(scan: Scan) -> Bool[np.ndarray, "b a"]:
    """The rays in sectors of MIN_SECTOR or more without any return; none of a scan without returns."""
    empty = ~scan.returned.any(axis=0)
    firings = len(empty)
    out = np.zeros(firings, dtype=bool)
    if empty.any() and not empty.all():
        first = int(np.flatnonzero(~empty)[0])  # a sector that crosses the last firing is in one piece from here
        rolled = np.roll(empty, -first)
        edges = np.flatnonzero(np.diff(rolled.astype(np.int8), prepend=0, append=0))
        for begin, end in edges.reshape(-1, 2):
            out[(np.arange(begin, end) + first) % firings] = (end - begin) * 2.0 * np.pi >= MIN_SECTOR * firings
    return np.broadcast_to(out, scan.rays.shape)


def _cells(scan: Scan) -> tuple[Int[np.ndarray, "b a"], Int[np.ndarray, "b a"]]:
    """The beam and the cell of azimuth of each ray."""
    turns = (scan.rays.azimuths.astype(np.float64) + np.pi) / (2.0 * np.pi)
    bins = np.floor(turns * AZIMUTH_BINS).astype(np.int64) % AZIMUTH_BINS
    return np.broadcast_to(np.arange(bins.shape[0])[:, None], bins.shape), bins
