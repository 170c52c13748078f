"""Checks of a dataset's values that all readers share. Each takes a value as it was read, of any type, and the name of
its record (a table and a token, or a file and an entry), with which its error begins."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import is_printable, named, shown, text_fault
from drivesplat.scene.rigid import rigid
from drivesplat.scene.sensors import Spin

MAX_COORDINATE = 1e8
"""Maximum coordinate in metres of a position: map projections of the earth stay below 4.1e7."""
MAX_MOUNT = 100.0
"""Maximum distance in metres of a sensor from the origin of the ego vehicle, along each axis."""
MAX_BOX = 1000.0
"""Maximum length, width and height of a box in metres."""
MAX_TIMESTAMP = 10**17
"""Maximum timestamp in microseconds, in the year 5138. Nanoseconds since 1970 are above it."""
FOCAL_RANGE = 0.1, 20.0
"""Allowed focal lengths, in image widths: 0.1 is a field of view of 157 degrees, 20 is one of 3 degrees."""
MAX_IMAGE = 100_000
"""Maximum width and height of an image in pixels."""
MAX_NAME, MAX_PATH = 255, 2000
"""Maximum number of bytes of a file's name, and of its path."""
MAX_READOUT_S = 1.0
MAX_STEPS = 1_000_000
"""Maximum readout time of an image, and number of firings of a beam per revolution."""
MAX_SPIN = 10.0
"""Maximum seconds of a revolution and of its start, and radians of the azimuth at which it begins."""
EXACT = 1e-9
"""Deviation from orthogonality that is rounding."""


def checked_text(value: Any, record: str, column: str, empty: bool = False) -> str:
    """A name or token; with `empty` also the empty text. Raises DatasetError naming `record` for any other value."""
    fault = text_fault(value) or (None if value or empty else "must not be empty")
    if fault:
        raise DatasetError(f"{record}: its {column} is {shown(value)}; it {fault}")
    return value


def checked_flag(value: Any, record: str, column: str) -> bool:
    """A boolean. Raises DatasetError naming `record` for any other value, such as the text "False"."""
    if not isinstance(value, bool):
        raise DatasetError(f"{record}: its {column} is {shown(value)}; it must be true or false")
    return value


def checked_timestamp(value: Any, record: str) -> int:
    """A timestamp in microseconds. Raises DatasetError naming `record` if it is no whole number from 0 to
    MAX_TIMESTAMP."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise DatasetError(f"{record}: its timestamp is {shown(value)}; it must be a whole number of microseconds")
    if not 0 <= value <= MAX_TIMESTAMP:
        raise DatasetError(f"{record}: its timestamp is {shown(value)}; it must be microseconds, from 0 to 1e17")
    return int(value)


def is_number(value: Any) -> bool:
    """Whether a value is a number: neither text nor a boolean. It may be NaN or infinite."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def checked_numbers(values: Any, count: int, bound: float, record: str, column: str, kind: str) -> np.ndarray:
    """`count` numbers of at most `bound`: (count,) float64. `kind` says what they are, such as 'metres'.

    Raises DatasetError naming `record` for another number of values, and for values that are no finite numbers or
    beyond the bound.
    """
    given = isinstance(values, list | tuple | np.ndarray) and len(values) == count
    if given and all(is_number(value) and abs(value) <= bound for value in values):
        return np.array(values, dtype=np.float64)
    if not (given and all(map(is_number, values))):
        raise DatasetError(f"{record}: its {column} is {shown(values)}; it must be {count} numbers ({kind})")
    if not all(abs(value) < np.inf for value in values):
        raise DatasetError(f"{record}: its {column} is {shown(values)}, which is not finite; it must be {kind}")
    raise DatasetError(f"{record}: its {column} is {shown(values)}; it must be {kind}, at most {bound:g}")


def checked_pose(translation: Any, rotation_wxyz: Any, record: str, bound: float = MAX_COORDINATE) -> np.ndarray:
    """The rigid transform (4, 4) of a translation in metres, at most `bound` along each axis, and a unit quaternion
    w, x, y, z.

    Raises DatasetError naming `record` if a value is no finite number, the translation beyond the bound, or the
    quaternion not of unit length (to 1e-3).
    """
    position = checked_numbers(translation, 3, bound, record, "translation", "metres")
    w, x, y, z = checked_numbers(rotation_wxyz, 4, 10.0, record, "rotation", "a unit quaternion w, x, y, z")
    length = float(np.linalg.norm([w, x, y, z]))
    if not abs(length - 1.0) <= 1e-3:
        raise DatasetError(f"{record}: its rotation is not a unit quaternion (length {length:.4g})")
    return rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), position)


def checked_transform(matrix: Any, record: str, bound: float = MAX_COORDINATE) -> np.ndarray:
    """A rigid transform (4, 4) given as a matrix: columns are the axes, the last one the translation in metres, at most
    `bound` along each axis.

    Raises DatasetError naming `record` if it is no 4x4 matrix of finite numbers, its last row is not 0, 0, 0, 1, or it
    mirrors, scales or shears (beyond 1e-3). A rotation that is orthogonal to rounding is returned as it is.
    """
    transform = _matrix(matrix, 4)
    if transform is None:
        raise DatasetError(f"{record}: its transform is {shown(matrix)}; it must be a 4x4 matrix of finite numbers")
    if not np.allclose(transform[3], [0.0, 0.0, 0.0, 1.0]):
        hint = "; it seems to be transposed" if np.allclose(transform[:, 3], [0.0, 0.0, 0.0, 1.0]) else ""
        raise DatasetError(f"{record}: the last row of its transform must be 0, 0, 0, 1{hint}")
    rotation = transform[:3, :3]
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max() if (np.abs(rotation) <= 2.0).all() else np.inf
    if deviation > 2e-3:
        raise DatasetError(f"{record}: its transform is not rigid: its axes must have unit length and right angles")
    if np.linalg.det(rotation) < 0:
        raise DatasetError(f"{record}: its transform mirrors: its axes must be right-handed (determinant 1, not -1)")
    position = checked_numbers(transform[:3, 3], 3, bound, record, "translation", "metres")
    exact = deviation < EXACT
    return rigid(rotation if exact else Rotation.from_matrix(rotation).as_matrix(), position)


def _matrix(values: Any, size: int) -> np.ndarray | None:
    """A square matrix (size, size) of finite numbers; None for anything else, such as numbers as text."""
    if not isinstance(values, list | tuple | np.ndarray) or len(values) != size:
        return None
    if not all(isinstance(row, list | tuple | np.ndarray) and len(row) == size for row in values):
        return None
    if not all(is_number(value) and abs(value) < 1e300 for row in values for value in row):
        return None
    return np.array(values, dtype=np.float64)


def checked_intrinsics(matrix: Any, record: str, size: tuple[int, int] | None = None) -> np.ndarray:
    """A pinhole K (3, 3), of images of `size` (width, height) if given.

    Raises DatasetError naming `record` if it is singular or malformed, its principal point is outside the image, or its
    focal lengths are outside FOCAL_RANGE.
    """
    k = _matrix(matrix, 3)
    no_skew = k is not None and k[0, 1] == 0 and k[1, 0] == 0
    if not (no_skew and k[0, 0] > 0 and k[1, 1] > 0 and np.allclose(k[2], [0, 0, 1])):
        raise DatasetError(f"{record}: its camera matrix is singular or not a pinhole matrix")
    if size is not None:
        least, most = FOCAL_RANGE[0] * size[0], FOCAL_RANGE[1] * size[0]
        for focal in (k[0, 0], k[1, 1]):
            if not least <= focal <= most:
                raise DatasetError(
                    f"{record}: its focal length is {focal:g} pixels; images of {size[0]}x{size[1]} pixels must have "
                    f"{least:g} to {most:g}"
                )
        if not (0 <= k[0, 2] <= size[0] and 0 <= k[1, 2] <= size[1]):
            raise DatasetError(
                f"{record}: its principal point ({k[0, 2]:g}, {k[1, 2]:g}) is outside its images of "
                f"{size[0]}x{size[1]} pixels; the camera matrix must be that of these images"
            )
    return k


def checked_size(width: Any, height: Any, record: str) -> tuple[int, int]:
    """An image's width and height in pixels. Raises DatasetError naming `record` if one is no whole number from 1 to
    MAX_IMAGE."""
    whole = all(is_number(value) and abs(value) < np.inf and value == int(value) for value in (width, height))
    if not (whole and 0 < width <= MAX_IMAGE and 0 < height <= MAX_IMAGE):
        raise DatasetError(
            f"{record}: its image size is {shown(width)}x{shown(height)}; it must be whole numbers of pixels"
        )
    return int(width), int(height)


def checked_box_size(size: Any, record: str) -> np.ndarray:
    """The three edges (3,) of a box in metres. Raises DatasetError naming `record` if one is not positive, or beyond
    MAX_BOX."""
    edges = checked_numbers(size, 3, MAX_BOX, record, "size", "metres")
    if not (edges > 0).all():
        raise DatasetError(f"{record}: its size is {shown(size)}; it must be three positive numbers of metres")
    return edges


def checked_path(name: Any, record: str, column: str = "filename") -> str:
    """The path of a file below the dataset's root, as it was given. Raises DatasetError naming `record` if it is no
    text, too long for a file system, absolute, or leads out of the root."""
    require_none(path_faults(name, record, column))
    return name


def path_faults(name: Any, record: str, column: str) -> Iterator[str]:
    """The fault, if any, for which `checked_path` refuses a path."""
    if not isinstance(name, str) or not name or not is_printable(name):
        yield f"{record}: its {column} is {shown(name)}; it must be the path of a file"
        return
    path = PurePosixPath(name)
    if len(name.encode()) > MAX_PATH or any(len(part.encode()) > MAX_NAME for part in path.parts):
        yield f"{record}: its {column} has {len(name)} characters, {shown(name)}; no file can have it"
    elif path.is_absolute() or PureWindowsPath(name).drive or ".." in path.parts or not path.parts:
        yield f"{record}: its {column} {shown(name)} must be a path below the dataset's root, without '..'"


def checked_readout(seconds: Any, direction: Any, record: str) -> tuple[float | None, str | None]:
    """The readout time of an image in seconds and its direction; None where unknown. Raises DatasetError naming
    `record` for a time outside 0 to MAX_READOUT_S, and for an unknown direction."""
    if seconds is not None and not (is_number(seconds) and 0 <= seconds <= MAX_READOUT_S):
        raise DatasetError(
            f"{record}: its readout time is {shown(seconds)}; it must be seconds, from 0 to {MAX_READOUT_S:g}"
        )
    if direction is not None and direction not in ("down", "up", "left", "right"):
        raise DatasetError(f"{record}: its readout direction is {shown(direction)}; it must be down, up, left or right")
    return (None if seconds is None else float(seconds)), direction


def checked_beams(elevations: Any, steps: Any, record: str) -> tuple[np.ndarray | None, int | None]:
    """A LiDAR's beam elevations (b,) in radians, and its firings of a beam per revolution; None where unknown. Raises
    DatasetError naming `record` for other values."""
    if elevations is not None:
        count = len(elevations) if isinstance(elevations, list | tuple | np.ndarray) else 0
        elevations = checked_numbers(elevations, max(1, count), np.pi / 2, record, "beam elevations", "radians")
    if steps is not None and not (is_number(steps) and 1 <= steps <= MAX_STEPS and steps == int(steps)):
        raise DatasetError(f"{record}: its azimuth steps are {shown(steps)}; they must be a whole number above 0")
    return elevations, (None if steps is None else int(steps))


def checked_spin(values: Any, record: str) -> Spin:
    """A LiDAR's spin, of a list [revolution_s, start_s, start_azimuth]: seconds, seconds and radians, clockwise.
    Raises DatasetError naming `record` for other values."""
    numbers = checked_numbers(values, 3, MAX_SPIN, record, "spin", "seconds of a revolution and of its start, radians")
    if numbers[0] <= 0.0:
        raise DatasetError(f"{record}: a revolution takes {numbers[0]:g} s; it must take more than 0")
    return Spin(*map(float, numbers))


def require_none(faults: Iterable[str]) -> None:
    """Raises DatasetError with the first of `faults`, if there is one."""
    for fault in faults:
        raise DatasetError(fault)


def require_increasing(timestamps: Sequence[int], tokens: Sequence[str], table: str) -> np.ndarray:
    """The timestamps (n,) int64 in microseconds.

    Raises DatasetError naming the first record that is not later than its predecessor.
    """
    require_none(order_faults(timestamps, lambda i: named(table, tokens[i])))
    return np.array(timestamps, dtype=np.int64)


def order_faults(timestamps: Sequence[int], record: Callable[[int], str]) -> Iterator[str]:
    """A sentence for every timestamp that is not later than its predecessor; `record` names the one at an index."""
    for index in (np.flatnonzero(np.diff(np.array(timestamps, dtype=np.int64)) <= 0) + 1).tolist():
        yield f"{record(index)}: its timestamp is not later than that of the one before it"
