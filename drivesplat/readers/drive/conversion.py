"""What converters to drive folders share: poses over time, messages about damaged files, and writing the folder."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.io.storage import write_json
from drivesplat.readers.drive.faults import faults_of
from drivesplat.readers.drive.format import FILE, structure_of
from drivesplat.readers.drive.write import pose_record, require_empty
from drivesplat.readers.files import link_or_copy
from drivesplat.scene.rigid import interpolate

FAILURES = (
    OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, SyntaxError, RuntimeError, EOFError,
    MemoryError,
)  # fmt: skip
"""What libraries raise for damaged files."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turns what goes wrong with a file or folder into a DatasetError that names it. Pipes and devices, whose reading
    may never end, are refused."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is not a file")
    try:
        yield
    except FileNotFoundError as error:
        raise DatasetError(f"{error.filename or path} is missing") from error
    except FAILURES as error:
        reason = "".join(letter if letter.isprintable() else " " for letter in str(error)[:200])
        raise DatasetError(f"{path} cannot be read ({type(error).__name__}: {reason})") from error


def numbers_of(text: str, count: int, record: str) -> np.ndarray:
    """The first `count` numbers (count,) of a text, separated by spaces. Raises DatasetError naming `record` where
    there are fewer, or one is not finite."""
    words = text.split()[:count]
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise DatasetError(f"{record}: {error}") from error
    if len(values) < count:
        raise DatasetError(f"{record} has {len(values)} numbers; it must have {count}")
    if not np.isfinite(values).all():
        raise DatasetError(f"{record} has a number that is not finite")
    return values


def warn(sentence: str) -> None:
    """Prints a warning of a converter."""
    print(f"warning: {sentence}", file=sys.stderr)


def reported(program: str, convert: Callable[[], Path]) -> int:
    """Runs a converter and prints the path of its drive.json, or what is wrong with its data; returns the exit status
    of the program."""
    try:
        print(convert())
    except DriveSplatError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 1
    return 0


def pose_at(times: np.ndarray, poses: np.ndarray, time: int | np.integer) -> np.ndarray:
    """The pose (4, 4) at a time, of poses (n, 4, 4) at increasing times (n,): between two of them linear position and
    slerp, outside them the motion of the nearest two."""
    if len(times) == 1:
        return poses[0]
    after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
    begin, end = times[after - 1], times[after]
    return interpolate(poses[after - 1], poses[after], float((time - begin) / (end - begin)))


def timed_poses(times: np.ndarray, poses: np.ndarray) -> list[dict[str, Any]]:
    """Poses (n, 4, 4) at times (n,) in microseconds as `ego_poses`, or those of a track."""
    return [{"timestamp": int(time), **pose_record(pose)} for time, pose in zip(times, poses, strict=True)]


def write_folder(
    folder: Path,
    record: Mapping[str, Any],
    images: Mapping[str, Path],
    sweeps: Iterable[tuple[str, Mapping[str, np.ndarray]]] = (),
) -> Path:
    """Writes an empty drive folder: `record` as drive.json, hard links to `images`, or copies, by their paths in the
    folder, and the columns of `sweeps`, one after the other, as .npz files. Returns the path of drive.json.

    Raises DatasetError where the folder holds anything, an image is missing, or `record` has a fault (`check`).

    >>> write_folder(Path("mine/0001"), record, {"front/1.jpg": Path("camera0/0001.jpg")})
    PosixPath('mine/0001/drive.json')
    """
    require_empty(folder)
    missing = [path for path in images.values() if not path.is_file()]
    if missing:
        raise DatasetError(f"{len(missing)} of {len(images)} images are missing (first: {missing[0]})")
    path = folder / FILE
    write_checked(path, record)
    path.unlink()  # it is the last file of a whole folder
    for name, source in images.items():
        link_or_copy(source, folder / name)
    for name, columns in sweeps:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(folder / name, **columns)
    write_json(path, record)
    return path


def write_checked(path: Path, record: Mapping[str, Any], name: Path | None = None) -> None:
    """Writes `record` as the drive.json `path`, which messages call `name` (`path`). Raises DatasetError, and leaves no
    file, where it has a fault."""
    shown = path if name is None else name
    try:
        write_json(path, record)
    except ValueError as error:
        raise DatasetError(f"{shown}: a number is not finite ({error})") from error
    faults, drive = structure_of(path)
    faults = [fault.replace(str(path), str(shown)) for fault in faults]
    if drive is not None:
        faults = [f"{shown}: {fault}" for fault in faults_of(drive)]
    if faults:
        path.unlink()
        more = f" ({len(faults) - 1} more faults)" if len(faults) > 1 else ""
        raise DatasetError(f"{faults[0]}{more}")
