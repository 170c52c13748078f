"""Sweeps of Waymo as `unpack` writes them: .npz with the returns as drive folders have them (x, y, z, intensity, ring)
and all rays of the range image: `azimuth` (columns,), `elevation` (rows,), `range` (rows, columns), NaN without a
return."""

from pathlib import Path

import numpy as np

from drivesplat.io.storage import atomic_write
from drivesplat.readers.drive.sweep_file import read_file
from drivesplat.readers.waymo.range_image import LaserRays
from drivesplat.scene.scan import Scan, ScanRays, wrapped
from drivesplat.scene.sensors import Spin

__all__ = ["rays_of", "read_file", "read_scan", "write_file"]


def write_file(
    path: Path, azimuth: np.ndarray, elevation: np.ndarray, ranges: np.ndarray, **returns: np.ndarray
) -> None:
    """Writes a sweep: `ranges` (rows, columns) with NaN for dropped returns, and the columns of `returns` by name.
    Raises ResultError naming the file where it cannot be written."""
    with atomic_write(path) as file:
        np.savez(file, azimuth=azimuth, elevation=elevation, range=ranges.astype(np.float32), **returns)


def read_scan(path: Path, spin: Spin | None) -> Scan:
    """The scan of a sweep, with times that follow from `spin`; None: all rays leave at the sweep's timestamp. Raises
    OSError, KeyError, ValueError or IndexError for a damaged file."""
    with np.load(path, allow_pickle=False) as arrays:
        azimuth, elevation, ranges, values = (arrays[n] for n in ("azimuth", "elevation", "range", "intensity"))
    returned = np.isfinite(ranges)
    offsets_s = np.zeros(len(azimuth)) if spin is None else spin.offsets_s(azimuth)
    intensities = np.zeros(ranges.shape, dtype=np.float32)
    intensities[returned] = values
    grid = (wrapped(azimuth), elevation[:, None], offsets_s)
    rays = ScanRays(*(np.broadcast_to(angles, ranges.shape).astype(np.float32) for angles in grid))
    return Scan(rays, returned, np.where(returned, ranges, 0.0).astype(np.float32), intensities)


def rays_of(azimuth: np.ndarray, elevation: np.ndarray, ranges: np.ndarray) -> LaserRays:
    """The rays of a range image (rows, columns), row by row."""
    shape = ranges.shape
    return LaserRays(
        np.broadcast_to(azimuth, shape).ravel(),
        np.broadcast_to(elevation[:, None], shape).ravel(),
        ranges.ravel(),
        np.broadcast_to(np.arange(shape[0])[:, None], shape).ravel(),
    )
