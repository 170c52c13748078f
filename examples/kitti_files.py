"""The text files of KITTI raw, and which recordings have which times, for kitti_raw.py. Errors name file and line."""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import checked_transform
from drivesplat.readers.drive.conversion import numbers_of, reading
from drivesplat.scene.rigid import rigid

MISSING = -1
"""The time of a lost recording."""
EARTH_RADIUS = 6378137.0
TIME = re.compile(r"(19|20)\d\d-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")


def lines_of(path: Path) -> list[str]:
    """The lines of a text file."""
    with reading(path):
        return path.read_text(encoding="utf-8").splitlines()


def calibration(path: Path, **counts: int) -> dict[str, np.ndarray]:
    """The values of a calibration file by their names, as many as `counts` says of each."""
    found = {}
    for number, line in enumerate(lines_of(path), 1):
        name, _, values = line.partition(":")
        if name in counts:
            found[name] = numbers_of(values, counts[name], f"{path} cannot be read: line {number}")
    lacking = [name for name in counts if name not in found]
    if lacking:
        raise DatasetError(f"{path} has no line that begins with {lacking[0]}:")
    return found


def transform(path: Path) -> np.ndarray:
    """The transform (4, 4) of a calibration file with R and T."""
    values = calibration(path, R=9, T=3)
    return checked_transform(rigid(values["R"].reshape(3, 3), values["T"]), str(path))


def timestamps(path: Path) -> np.ndarray:
    """The times (n,) in microseconds of a file with a time per line, such as 2011-09-26 13:02:25.964389445; MISSING for
    an empty line, which stands for a lost recording."""
    times = []
    for number, line in enumerate(lines_of(path), 1):
        try:
            if line.strip() and not TIME.fullmatch(line.strip()):
                raise ValueError
            time = np.datetime64(line.strip() or "NaT", "ns")
        except ValueError:
            raise DatasetError(
                f"{path} cannot be read: line {number} is {line[:40]!r}, and no time such as "
                "2011-09-26 13:02:25.964389445"
            ) from None
        times.append(MISSING if np.isnat(time) else int(time.astype(np.int64)) // 1000)
    return np.array(times, dtype=np.int64)


def time_of(path: Path, times: np.ndarray, index: int, recording: Path) -> int:
    """The time of a recording, in the line `index` + 1 of the file at `path` with `times`."""
    if index >= len(times) or times[index] == MISSING:
        raise DatasetError(f"{path}: line {index + 1} has no time, and there is {recording}")
    return int(times[index])


def recordings(folder: Path, suffix: str) -> list[tuple[int, int, Path]]:
    """Of each file of a sensor: its index, which is a line of timestamps.txt, its time, and its path. A drive may lack
    some."""
    path, files = folder / "timestamps.txt", sorted((folder / "data").glob(f"*{suffix}"))
    times = timestamps(path)
    if not files:
        raise DatasetError(f"{folder / 'data'} holds no {suffix} files")
    unnumbered = next((file for file in files if not file.stem.isdecimal()), None)
    if unnumbered:
        raise DatasetError(f"{unnumbered}: the name of a recording must be its number")
    return [(int(file.stem), time_of(path, times, int(file.stem), file), file) for file in files]


def imu_poses(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The times (n,) and the poses (n, 4, 4) of the GPS/IMU unit: x east, y north, z up."""
    records, rows = recordings(folder, ".txt"), []
    times = np.array([time for _, time, _ in records])
    for index in np.flatnonzero(np.diff(times) <= 0)[:1]:
        raise DatasetError(f"{folder / 'timestamps.txt'}: line {records[index + 1][0] + 1} is not later than before")
    for _, _, path in records:
        rows.append(numbers_of("".join(lines_of(path)[:1]), 6, f"{path} cannot be read: line 1"))
        if max(abs(rows[-1][0]) / 85.0, abs(rows[-1][1]) / 180.0) > 1.0:
            raise DatasetError(f"{path}: line 1 begins with no latitude and longitude ({rows[-1][:2].tolist()})")
    latitude, longitude, altitude, roll, pitch, yaw = np.array(rows).T
    scale = EARTH_RADIUS * np.cos(np.radians(latitude[0]))
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.radians(90.0 + latitude) / 2))
    rotations = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix()
    return times, rigid(rotations, np.stack([east, north, altitude], axis=1))
