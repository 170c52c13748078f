"""Renderings of a drive along the poses of a file, as images in a folder. Files of poses are text in TUM's format,
tables or camera paths of nerfstudio."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from drivesplat.drive.cameras import require_pose
from drivesplat.drive.drive_view import DriveView
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.io.storage import write_json
from drivesplat.io.video import write_video
from drivesplat.readers.truth import depth_units, numbered
from drivesplat.scene.images import read_image, write_png
from drivesplat.scene.rigid import rigid

WRITTEN = ("rgb", "depth", "instance")
"""The outputs that can be written as images."""
FILM_CRF, MIN_FPS = 18, 0.1
"""The quality of a film, from 0 (no loss) to 51, and its least frames per second."""
COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
"""Those of a table: seconds since the first image, metres, and a quaternion."""
TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
"""Those of a line in TUM's format, whose quaternions end with w."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def render_poses(
    drive: TrainedDrive,
    poses: str | Path,
    camera: str | None,
    outputs: Sequence[str],
    folder: str | Path,
    of_ego: bool = False,
    film: str | Path | None = None,
) -> int:
    """Writes what a recorded camera sees at the times and poses of a file; returns the number of images of each output.

    Args:
        drive: What is rendered.
        poses: A file of `drivesplat.drive.render_files.read_poses`: those of the camera, or `of_ego`, of the vehicle.
        camera: The name of a recorded camera; None: the one that looks ahead the most.
        outputs: Names from WRITTEN.
        folder: Where `{output}/{number}.png` and `render.json` are written. Depth has 16 bits, 256 units a metre, 0
            where there is no surface; instances have 16 bits, 0 for none, else the number in `objects` of render.json.
        film: An MP4 file of the images `rgb`, at the mean rate of the poses; the last odd row and column are cut off.

    Raises RequestError as `TrainedDrive.render` and `read_poses` do, and for a film of poses that are not in the order
    of time or without `rgb`; ResultError where the film cannot be written.
    """
    if unknown := [name for name in outputs if name not in WRITTEN]:
        raise RequestError(f"output {unknown[0]!r} cannot be written; there are: {', '.join(WRITTEN)}")
    folder, known = Path(folder), read_poses(poses)
    camera = drive.recording.front_camera if camera is None else camera
    fps = None if film is None else _film_rate(known.times, outputs, poses)
    for time in known.times.tolist():
        drive.recording.checked(time)
    try:
        for name in WRITTEN:  # of an earlier run
            for file in folder.glob(f"{name}/{'[0-9]' * 6}.png"):
                file.unlink()
        for name in outputs:
            (folder / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"{folder} cannot be made: {error.strerror}") from None
    numbers: dict[str, int] = {}
    frames = []
    for number, (time, pose) in enumerate(zip(known.times.tolist(), known.poses, strict=True)):
        at = {"ego_to_world" if of_ego else "camera_to_world": require_pose(pose, f"{poses}, pose {number}")}
        view = drive.render(camera, time, outputs=outputs, **at)
        for item in view.objects:
            numbers.setdefault(item, len(numbers) + 1)
        images = {name: f"{name}/{number:06d}.png" for name in outputs}
        for name, file in images.items():
            write_png(folder / file, _pixels(view, name, numbers))
        frames.append({"time": time, **{name: matrix.tolist() for name, matrix in at.items()}, "images": images})
    intrinsics = drive.camera(camera).K.tolist()
    record: dict[str, Any] = {"camera": camera, "K": intrinsics, "objects": numbers, "frames": frames}
    write_json(folder / "render.json", record)
    if film is not None and fps is not None:
        seen = drive.camera(camera)
        width, height = seen.width // 2 * 2, seen.height // 2 * 2
        shown = (read_image(folder / frame["images"]["rgb"])[:height, :width] for frame in frames)
        write_video(Path(film), shown, (width, height), fps, FILM_CRF)
    return len(frames)


def _film_rate(times: Float64[np.ndarray, " n"], outputs: Sequence[str], poses: str | Path) -> float:
    """Frames per second of a film of poses at `times`. Raises RequestError where there can be none."""
    if "rgb" not in outputs:
        raise RequestError("a film shows the images rgb: add rgb to the outputs")
    if len(times) < 2 or (np.diff(times) <= 0.0).any():
        raise RequestError(f"{poses}: a film needs two or more poses in the order of their times")
    return max(MIN_FPS, round((len(times) - 1) / float(times[-1] - times[0]), 2))


def _pixels(view: DriveView, name: str, numbers: dict[str, int]) -> np.ndarray:
    if name == "rgb":
        return view.image
    values = view.arrays()[name]
    return depth_units(values) if name == "depth" else numbered(values, [numbers[item] for item in view.objects])


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
