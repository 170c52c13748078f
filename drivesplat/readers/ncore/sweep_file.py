"""Sweeps of NCore as `unpack` writes them: .npz with all n rays in the sensor's frame at their own times. `direction`
(n, 3), `range` (n,) in metres and `intensity` (n,), NaN without a return; `time` (n,), seconds after the sweep's
timestamp; where known `row` and `column` (n,), and of the sensor's model `row_elevations` (rows,), `column_azimuths`
(columns,) and `row_offsets` (rows,) in radians, by which rays are known that have no entry."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import atomic_write
from drivesplat.scene.scan import Scan, ScanRays, wrapped
from drivesplat.scene.sensors import LidarReturns, Spin

RAY_COLUMNS = ("range", "intensity", "time")
ELEMENTS = ("row", "column")
MODEL = ("row_elevations", "column_azimuths", "row_offsets")


def write_file(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a sweep. Raises ResultError naming the file where it cannot be written."""
    with atomic_write(path) as file:
        np.savez(file, **arrays)


def read_file(path: Path) -> LidarReturns | str:
    """The returns of an existing file, each at its own time, or its fault as the end of a sentence."""
    try:
        arrays = _arrays(path)
    except (OSError, KeyError, ValueError, IndexError, EOFError, zipfile.BadZipFile) as error:
        return f"is corrupt ({' '.join(str(error).split())[:200]})"
    hit = np.isfinite(arrays["range"]) & (arrays["range"] > 0)
    if not hit.any():
        return "is empty"
    points = arrays["direction"][hit].astype(np.float64) * arrays["range"][hit, None].astype(np.float64)
    rows = arrays["row"][hit].astype(np.int64) if "row" in arrays else None
    intensity = np.nan_to_num(arrays["intensity"][hit], nan=0.0).clip(0.0, 1.0).astype(np.float32)
    return LidarReturns(points, intensity, rows, arrays["time"][hit].astype(np.float64))


def read_scan(path: Path, spin: Spin | None) -> Scan | None:
    """The scan of a sweep, whose rays have the times of the file; rays without an entry have the angles of the sensor's
    model and the time of their column. None where rays have no row and column. Raises OSError, KeyError, ValueError or
    IndexError where the file is damaged."""
    arrays = _arrays(path)
    if not all(name in arrays for name in (*ELEMENTS, *MODEL)):
        return None
    elevations, columns, offsets = (arrays[name].astype(np.float64) for name in MODEL)
    shape = len(elevations), len(columns)
    cells = arrays["row"].astype(np.int64), arrays["column"].astype(np.int64)
    order = np.argsort(-np.nan_to_num(arrays["range"], nan=np.inf), kind="stable")  # the nearest of a cell stays
    cells = cells[0][order], cells[1][order]
    x, y, z = arrays["direction"][order].astype(np.float64).T

    def filled(empty: np.ndarray, values: np.ndarray) -> np.ndarray:
        array = np.broadcast_to(empty, shape).astype(np.float32)
        array[cells] = values
        return array

    rays = ScanRays(
        wrapped(filled(wrapped(columns[None] + offsets[:, None]), np.arctan2(y, x))),
        filled(elevations[:, None], np.arcsin(z.clip(-1.0, 1.0))),
        filled(_column_times(cells[1], arrays["time"][order], len(columns)), arrays["time"][order]),
    )
    ranges = np.nan_to_num(filled(np.zeros(()), arrays["range"][order]), nan=0.0)
    returned = ranges > 0
    intensities = np.nan_to_num(filled(np.zeros(()), arrays["intensity"][order]), nan=0.0).clip(0.0, 1.0)
    return Scan(rays, returned, ranges, intensities * returned)


def _column_times(columns: np.ndarray, times: np.ndarray, count: int) -> np.ndarray:
    """The mean time (count,) of the rays of each column; between and beyond columns with rays, that in proportion to
    the columns."""
    rays = np.bincount(columns, minlength=count)
    known = np.flatnonzero(rays)
    means = np.bincount(columns, times, minlength=count)[known] / rays[known]
    if len(known) < 2:
        return np.full(count, means[0] if len(known) else 0.0)
    step = (means[-1] - means[0]) / (known[-1] - known[0])
    every = np.arange(count)
    found = np.interp(every, known, means)
    return found + step * (np.minimum(every - known[0], 0) + np.maximum(every - known[-1], 0))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file, with as many rays each. Raises ValueError where they do not fit together."""
    with np.load(regular_file(path), allow_pickle=False) as file:
        arrays = {name: file[name] for name in ("direction", *RAY_COLUMNS)}
        arrays |= {name: file[name] for name in (*ELEMENTS, *MODEL) if name in file.files}
    count = len(arrays["direction"])
    for name, values in arrays.items():
        shape = (count, 3) if name == "direction" else (len(values),) if name in MODEL else (count,)
        if values.shape != shape or values.dtype.kind not in "fiu":
            raise ValueError(f"its {name} has the shape {values.shape}")
    for name, model in zip(ELEMENTS, ("row_elevations", "column_azimuths"), strict=True):
        most = len(arrays[model]) if model in arrays else np.inf
        if name in arrays and count and not 0 <= arrays[name].min() <= arrays[name].max() < most:
            raise ValueError(f"its {name} is beyond the sensor's")
    for name in ("direction", "time", *MODEL):
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise ValueError(f"its {name} is not finite")
    if count and not np.allclose(np.linalg.norm(arrays["direction"], axis=1), 1.0, atol=1e-2):
        raise ValueError("its directions have not unit length")
    return arrays
