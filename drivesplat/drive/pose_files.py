"""Files of poses over time, to render a drive from: TUM's text format, tables, and camera paths of nerfstudio."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from drivesplat.errors import RequestError
from drivesplat.scene.rigid import rigid

COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
"""Those of a table: seconds since the first image, metres, and a quaternion."""
TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Those of a line in TUM's format, whose quaternions end with w."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class TimedPoses:
    """n `poses` in the world at `times`, seconds since the first image."""

    times: Float64[np.ndarray, " n"]
    poses: Float64[np.ndarray, "n 4 4"]


def read_poses(path: str | Path) -> TimedPoses:
    """The poses of a file.

    Args:
        path: `.csv` with the columns of COLUMNS in any order; `.json` as nerfstudio's viewer exports camera paths
            (OpenGL axes, `fps` or `seconds`); anything else is text in TUM's format, `time x y z qx qy qz qw` a line,
            `#` begins a comment (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats).

    Raises RequestError, which names the file and the line, for what is none of these.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"{path} cannot be read as text: {error}") from None
    if path.suffix == ".json":
        return _of_camera_path(path, text)
    rows = _rows_of_table(path, text) if path.suffix == ".csv" else _rows_of_text(path, text)
    if not rows:
        raise RequestError(f"{path} has no pose")
    values = np.array(rows)
    return TimedPoses(values[:, 0], rigid(Rotation.from_quat(values[:, [5, 6, 7, 4]]).as_matrix(), values[:, 1:4]))


def _rows_of_table(path: Path, text: str) -> list[list[float]]:
    table = csv.DictReader(text.splitlines())
    if missing := [name for name in COLUMNS if name not in (table.fieldnames or ())]:
        raise RequestError(f"{path} has no column {missing[0]!r}; its first line must name {', '.join(COLUMNS)}")
    return [_checked([row[name] for name in COLUMNS], f"{path}, line {table.line_num}") for row in table]


def _rows_of_text(path: Path, text: str) -> list[list[float]]:
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        where = f"{path}, line {number}"
        if len(fields) != len(TUM):
            raise RequestError(f"{where}: {len(fields)} fields; a line is {' '.join(TUM)}")
        rows.append(_checked([fields[TUM.index(name)] for name in COLUMNS], where))
    return rows


def _checked(fields: Sequence[str | None], where: str) -> list[float]:
    """The fields of COLUMNS as numbers."""
    try:
        values = [float(field or "") for field in fields]
    except ValueError:
        raise RequestError(f"{where}: {', '.join(map(str, fields))} are not all numbers") from None
    if not all(map(math.isfinite, values)) or abs(math.hypot(*values[4:]) - 1.0) > 1e-3:
        raise RequestError(f"{where}: a pose has finite numbers, and a quaternion of length 1")
    return values


def _of_camera_path(path: Path, text: str) -> TimedPoses:
    try:
        content = json.loads(text)
        matrices = np.array([key["camera_to_world"] for key in content["camera_path"]], dtype=np.float64)
        poses = matrices.reshape(-1, 4, 4) @ OPENGL_TO_OPENCV
        fps = float(content.get("fps") or (len(poses) - 1) / float(content["seconds"]))
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        needs = "camera_path, camera_to_world and fps"
        raise RequestError(f"{path} is no camera path of nerfstudio: it needs {needs} ({error})") from None
    if not len(poses) or not np.isfinite(poses).all() or not fps > 0.0:
        raise RequestError(f"{path} has no pose, or one with NaN, or no frame rate")
    return TimedPoses(np.arange(len(poses)) / fps, poses)
