"""Checks of a dataset's values that all readers share; errors name the record."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.scene.rigid import rigid


def checked_pose(translation: Sequence[float], rotation_wxyz: Sequence[float], record: str) -> np.ndarray:
    """The rigid transform (4, 4) of a translation in metres and a unit quaternion w, x, y, z.

    Raises DatasetError naming `record` if a value is not finite or the quaternion not of unit length (to 1e-3).
    """
    values = np.array([*translation, *rotation_wxyz], dtype=np.float64)
    if values.shape != (7,) or not np.isfinite(values).all():
        raise DatasetError(f"{record}: its pose is not seven finite numbers")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > 1e-3:
        raise DatasetError(f"{record}: its rotation is not a unit quaternion (length {length:.4f})")
    w, x, y, z = values[3:]
    return rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), values[:3])


def checked_intrinsics(matrix: Sequence[Sequence[float]], record: str) -> np.ndarray:
    """A pinhole K (3, 3). Raises DatasetError naming `record` if it is singular or malformed."""
    try:
        k = np.array(matrix, dtype=np.float64)
    except ValueError:
        k = np.empty(0)
    if not (k.shape == (3, 3) and np.isfinite(k).all() and _is_pinhole(k)):
        raise DatasetError(f"{record}: its camera matrix is singular or not a pinhole matrix")
    return k


def _is_pinhole(k: np.ndarray) -> bool:
    no_skew = k[0, 1] == 0 and k[1, 0] == 0
    return bool(no_skew and k[0, 0] > 0 and k[1, 1] > 0 and np.allclose(k[2], [0, 0, 1]))


def checked_size(width: int, height: int, record: str) -> tuple[int, int]:
    """An image's width and height in pixels. Raises DatasetError naming `record` if one is not positive."""
    if not (width > 0 and height > 0):
        raise DatasetError(f"{record}: its image size is {width}x{height}")
    return int(width), int(height)


def require_increasing(timestamps: Sequence[int], tokens: Sequence[str], table: str) -> np.ndarray:
    """The timestamps (n,) int64 in microseconds.

    Raises DatasetError naming the first record that is not later than its predecessor.
    """
    times = np.array(timestamps, dtype=np.int64)
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if len(wrong):
        raise DatasetError(f"{table} {tokens[wrong[0] + 1]}: its timestamp is not later than that of the one before it")
    return times
