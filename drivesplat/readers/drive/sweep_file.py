"""Sweeps of drive folders: .npz with arrays, or .ply with vertex properties, called x, y, z (metres, in the sensor's
frame at the sweep's timestamp) and, where known, intensity (0 to 1), ring (index of the beam) and time (seconds after
the sweep's timestamp)."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElementParseError, PlyHeaderParseError

from drivesplat.scene.sensors import LidarReturns

AXES = ("x", "y", "z")
OPTIONAL = ("intensity", "ring", "time")


def read_file(path: Path) -> LidarReturns:
    """The returns with finite coordinates, of a file without a fault."""
    return _returns_of(_columns(path))


def file_fault(path: Path) -> str | None:
    """The fault of an existing file, or None. `drivesplat.readers.sweeps` checks the returns, as for all readers."""
    found = read_checked(path)
    return found if isinstance(found, str) else None


def read_checked(path: Path) -> LidarReturns | str:
    """The returns with finite coordinates of an existing file, or its fault: reads the file once."""
    try:
        columns = _columns(path)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, PlyHeaderParseError, PlyElementParseError) as error:
        return f"is corrupt ({' '.join(str(error).split())[:200]})"
    return _columns_fault(columns) or _returns_of(columns)


def _returns_of(columns: Mapping[str, np.ndarray]) -> LidarReturns:
    points = np.stack([columns[name] for name in AXES], axis=1).astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    optional: dict[str, Any] = {name: columns[name][finite] for name in OPTIONAL if name in columns}
    intensity, ring, time = (optional.get(name) for name in OPTIONAL)
    return LidarReturns(
        points[finite],
        None if intensity is None else intensity.astype(np.float32),
        None if ring is None else ring.astype(np.int64),
        None if time is None else time.astype(np.float64),
    )


def _columns_fault(columns: Mapping[str, np.ndarray]) -> str | None:
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1:
        return f"is corrupt (its columns have {', '.join(map(str, sorted(lengths)))} rows)"
    if not lengths.pop():
        return "is empty"
    intensity = columns.get("intensity")
    if intensity is not None and ((intensity < 0) | (intensity > 1)).any():
        return f"has intensities up to {float(np.nanmax(intensity)):.3g}; divide them, so that they lie in [0, 1]"
    return None


def _columns(path: Path) -> Mapping[str, np.ndarray]:
    """The known columns of a file as flat arrays. Raises KeyError for one that lacks a coordinate."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in (*AXES, *OPTIONAL) if name in arrays.files}
    elif path.suffix == ".ply":
        vertices = PlyData.read(str(path))["vertex"].data
        found = {name: np.asarray(vertices[name]) for name in (*AXES, *OPTIONAL) if name in vertices.dtype.names}
    else:
        raise ValueError(f"{path.suffix or 'no suffix'}: sweeps are .npz or .ply")
    lacking = [name for name in AXES if name not in found]
    if lacking:
        raise ValueError(f"it has no {', '.join(lacking)}")
    wrong = [name for name, values in found.items() if values.ndim != 1 or values.dtype.kind not in "fiu"]
    if wrong:
        raise ValueError(f"{', '.join(wrong)} is no column of numbers")
    return found
