"""The Velodyne scans of KITTI raw: their returns, rings, beams and times, for kitti_raw.py.

A .bin holds x, y, z and reflectance of each return, ring by ring from the top, with azimuths that increase from 0 to
360 degrees within a ring. It names neither rings nor times.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.conversion import reading
from drivesplat.scene.rigid import apply, inverse
from examples.kitti_files import time_of, timestamps

RINGS = 64
"""Of the HDL-64E."""
MAX_SPREAD = np.radians(0.5)
"""Median deviation of returns from the elevation of their ring, above which a file has another order."""
MEASURED_SCANS = 20
"""Scans from which elevations are measured."""
MAX_REVOLUTION_US = 1_000_000


def read_scan(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The points (n, 3) in metres and the reflectance (n,) of a scan's file."""
    with reading(path):
        values = np.frombuffer(path.read_bytes(), dtype="<f4").reshape(-1, 4).astype(float)
    if not len(values):
        raise DatasetError(f"{path} holds no returns")
    wrong = int((~np.isfinite(values)).any(axis=1).sum())
    if wrong:
        raise DatasetError(f"{path}: {wrong} of its {len(values)} returns have values that are not finite")
    return values[:, :3], values[:, 3].clip(0.0, 1.0)


def laps_of(points: np.ndarray) -> np.ndarray:
    """How often the azimuth has jumped back to 0 before each of the returns (n,)."""
    azimuths = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    return np.concatenate([[0], np.cumsum(np.diff(azimuths) < -np.pi)])


def elevations_of(points: np.ndarray) -> np.ndarray:
    """The elevations (n,) of returns in radians."""
    return np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))


def medians(values: np.ndarray, laps: np.ndarray) -> np.ndarray:
    """The median of the values of each lap."""
    return np.array([np.median(part) for part in np.split(values, np.flatnonzero(np.diff(laps)) + 1)])


def beams_of(paths: Iterable[Path]) -> np.ndarray | None:
    """The elevation (64,) in radians of each ring: the median of its returns, over the first scans whose files have all
    rings in their order. None where no scan has them."""
    found: list[np.ndarray] = []
    for path in paths:
        points, _ = read_scan(path)
        laps, elevations = laps_of(points), elevations_of(points)
        if laps[-1] == RINGS - 1:
            of_laps = medians(elevations, laps)
            if np.median(np.abs(elevations - of_laps[laps])) < MAX_SPREAD:
                found.append(of_laps)
        if len(found) == MEASURED_SCANS:
            break
    return np.median(found, axis=0) if found else None


def rings_of(points: np.ndarray, beams: np.ndarray) -> np.ndarray | None:
    """The ring (n,) of each return, by the order of the file. If that has another number of laps than rings, each lap
    is the ring of the nearest of `beams` (64,). None where returns come in another order."""
    laps, elevations = laps_of(points), elevations_of(points)
    if laps[-1] >= 2 * RINGS:
        return None
    rings = laps
    if laps[-1] != RINGS - 1:
        rings = np.abs(medians(elevations, laps)[:, None] - beams).argmin(axis=1)[laps]
    return rings if np.median(np.abs(elevations - beams[rings])) < MAX_SPREAD else None


def shares_of(points: np.ndarray, scans: str) -> np.ndarray:
    """The share (n,) of the revolution before each return; it begins and ends behind the vehicle."""
    azimuths = np.arctan2(points[:, 1], points[:, 0]) * (1 if scans == "counter-clockwise" else -1)
    return (azimuths + np.pi) / (2 * np.pi)


def untwisted(points: np.ndarray, scans: str, start: np.ndarray, end: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The points (n, 3) of a scan as seen from the pose `forward`; the scanner turned once from `start` to `end`, from
    behind the vehicle to behind it. Poses are scanner to world (4, 4)."""
    if scans == "compensated":
        return points
    shares, motion = shares_of(points, scans)[:, None], inverse(start) @ end
    turns = Rotation.from_rotvec(shares * Rotation.from_matrix(motion[:3, :3]).as_rotvec())
    return apply(inverse(forward) @ start, turns.apply(points) + shares * motion[:3, 3])


def scan_times(folder: Path, files: list[tuple[int, int, Path]]) -> list[tuple[int, int, int]]:
    """The times of each scan at which its revolution begins, the scanner faces forward, and the revolution ends."""
    paths = [folder / f"timestamps_{name}.txt" for name in ("start", "end")]
    times, found = [timestamps(path) for path in paths], []
    for index, forward, file in files:
        start, end = (time_of(path, of_scans, index, file) for path, of_scans in zip(paths, times, strict=True))
        if not (start <= forward <= end and 0 < end - start < MAX_REVOLUTION_US):
            raise DatasetError(
                f"{paths[0]}: line {index + 1}: the scan begins {(forward - start) * 1e-6:g} s before and ends "
                f"{(end - forward) * 1e-6:g} s after its time in timestamps.txt; a revolution takes 0.1 s"
            )
        found.append((start, forward, end))
    return found
