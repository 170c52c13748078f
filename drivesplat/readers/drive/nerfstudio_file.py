"""Reads transforms.json of nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html).

Its cameras look along -z, with x to the right and y up, as in OpenGL. Its pixel coordinates begin at the corner of the
image: the centre of the first pixel is (0.5, 0.5), in OpenCV (0, 0). As in nerfstudio, values at the top of the file go
before those of a frame.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file
from drivesplat.readers.checks import MAX_TIMESTAMP, checked_path, checked_size, checked_transform, is_number
from drivesplat.readers.record_names import is_printable, shown
from drivesplat.scene.images import DECODING_ERRORS

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE = "OPENCV_FISHEYE"
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
CAMERA_KEYS = ("camera", "camera_id", "camera_name")
"""Keys of a frame that name its camera."""
TIME_KEYS = ("timestamp", "time")


@dataclass(frozen=True)
class TransformsLens:
    """The intrinsics of images, as OpenCV defines them."""

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    """Pixels; the centre of the first pixel is (0, 0)."""
    model: str
    """none, opencv or fisheye."""
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class TransformsFrame:
    """An image of a transforms.json. `camera` is None where the file does not name it; `camera_to_world` (4, 4) is that
    of an OpenCV camera, in the file's units."""

    record: str
    """For messages."""
    path: Path
    camera: str | None
    time: int
    """Microseconds."""
    camera_to_world: np.ndarray
    lens: TransformsLens


def content_of(path: Path) -> dict[str, Any]:
    """The content of a transforms.json with at least one frame. Raises DatasetError for anything else."""
    if path.exists() and not path.is_file():
        raise DatasetError(f"{path} is not a file")
    try:
        values = json.loads(regular_file(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is not JSON ({type(error).__name__}: {str(error)[:200]})") from error
    frames = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DatasetError(f"{path} has no frames; it must be a transforms.json of nerfstudio, with a list of images")
    return values


def shots_of(
    values: Mapping[str, Any], path: Path, seconds_per_time: float | None, hz: float | None
) -> list[TransformsFrame]:
    """The images of the content of a transforms.json at `path`, with a unit of their times, or with the rate of images
    that have no times. Raises DatasetError naming a frame whose values cannot be, or whose image is missing."""
    frames, folder, found = values["frames"], path.parent, []
    times = _times(values, path, seconds_per_time, hz)
    for number, (frame, time) in enumerate(zip(frames, times, strict=True)):
        record = f"{path}: frames[{number}]"
        image = folder / _file(frame, record)
        found.append(
            TransformsFrame(
                record=record,
                path=image,
                camera=_camera_name(frame, record),
                time=time,
                camera_to_world=_transform(frame.get("transform_matrix"), record) @ OPENGL_TO_OPENCV,
                lens=_lens(values, frame, image, record),
            )
        )
    return found


def _times(values: Mapping[str, Any], path: Path, seconds_per_time: float | None, hz: float | None) -> list[int]:
    """The times of frames in microseconds, as stated in all of them; or with a rate `hz` of files without times, from
    0: the images of each camera, or folder, in the order of the numbers in their names."""
    key = next((key for key in TIME_KEYS if all(key in frame for frame in values["frames"])), None)
    records = {f"{path}: frames[{number}]": frame for number, frame in enumerate(values["frames"])}
    if hz is not None:
        if key is not None:
            raise DatasetError(f"{path}: its frames have a {key}; leave out --hz, and state --seconds-per-time")
        cameras: dict[tuple[str | None, str], list[tuple[list[Any], int]]] = {}
        for number, (record, frame) in enumerate(records.items()):
            file = _file(frame, record)
            order = [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]
            cameras.setdefault((_camera_name(frame, record), str(file.parent)), []).append((order, number))
        times = [0] * len(records)
        for of_camera in cameras.values():
            for position, (_, number) in enumerate(sorted(of_camera)):
                times[number] = round(position * 1e6 / hz)
        return times
    if key is None:
        lacking = next(i for i, frame in enumerate(values["frames"]) if TIME_KEYS[0] not in frame)
        raise DatasetError(
            f"{path}: frames[{lacking}] has no timestamp and not all frames have a time; a drive needs the time of "
            "every image: add them, or state --hz where images of each camera were taken at a constant rate"
        )
    if seconds_per_time is None:
        raise DatasetError(
            "a transforms.json does not say it, so state --seconds-per-time: the seconds of a unit of timestamp or "
            "time (1e-6 if microseconds, 1 if seconds, the drive's length if it goes from 0 to 1)"
        )
    times = []
    for record, frame in records.items():
        value = frame[key]
        if not is_number(value) or not abs(value) < 1e300:
            raise DatasetError(f"{record}: its {key} is {shown(value)}; it must be a finite number")
        time = value * (seconds_per_time * 1e6)
        if not 0 <= time <= MAX_TIMESTAMP:
            raise DatasetError(
                f"{record}: its {key} is {shown(value)}, which is {time:g} microseconds; times must be from 0 to "
                f"{MAX_TIMESTAMP:g}, so check --seconds-per-time"
            )
        times.append(round(time))
    return times


def applied_transform(values: Mapping[str, Any], path: Path) -> np.ndarray:
    """The transform (4, 4) that a file says was applied to its poses; the identity where it says none."""
    if "applied_transform" not in values:
        return np.eye(4)
    return _transform(values["applied_transform"], f"{path}: applied_transform")


def _transform(matrix: Any, record: str) -> np.ndarray:
    """A rigid transform given with or without its last row."""
    if isinstance(matrix, list) and len(matrix) == 3:
        matrix = [*matrix, [0.0, 0.0, 0.0, 1.0]]
    return checked_transform(matrix, record)


def _file(frame: Mapping[str, Any], record: str) -> Path:
    """The path of an image beside the file; nerfstudio also takes those elsewhere."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not is_printable(name) or not name:
        raise DatasetError(f"{record}: its file_path is {shown(name)}; it must be the path of an image")
    plain = str(PurePosixPath(name)).replace("../", "").lstrip("/")
    checked_path(plain, record, "file_path")
    return Path(name)


def _camera_name(frame: Mapping[str, Any], record: str) -> str | None:
    for key in CAMERA_KEYS:
        name = frame.get(key)
        if name is None:
            continue
        if isinstance(name, bool) or not isinstance(name, str | int) or not str(name).strip():
            raise DatasetError(f"{record}: its {key} is {shown(name)}; it must be a name or a number")
        return clean_name(f"camera_{name}" if isinstance(name, int) else name)
    return None


def clean_name(name: str) -> str:
    """A name that a folder can have."""
    return re.sub(r"[^\w-]+", "_", name)[:100]


def _lens(values: Mapping[str, Any], frame: Mapping[str, Any], image: Path, record: str) -> TransformsLens:
    """The intrinsics of a frame, whose image must have the size that they are for."""
    fl_x, fl_y, cx, cy = (_number(values, frame, key, record) for key in ("fl_x", "fl_y", "cx", "cy"))
    if not image.is_file():
        wrong = "cannot be read (it is not a file)" if image.exists() else "is missing"
        raise DatasetError(f"{record}: image {image} {wrong}")
    try:
        with Image.open(image) as opened:
            size = opened.size
    except DECODING_ERRORS as error:
        raise DatasetError(f"{record}: image {image} cannot be read ({error})") from error
    stated = [values.get(key, frame.get(key, found)) for key, found in zip(("w", "h"), size, strict=True)]
    if checked_size(*stated, record) != size:
        raise DatasetError(
            f"{record}: image {image} is {size[0]}x{size[1]}, its w and h say {stated[0]}x{stated[1]}; intrinsics must "
            "be those of the images"
        )
    named = values.get("camera_model", frame.get("camera_model", PERSPECTIVE[0]))
    holder = values if any(key in values for key in DISTORTION) else frame
    k1, k2, k3, k4, p1, p2 = (_number(holder, {}, key, record, 0.0) for key in DISTORTION)
    pinhole = *size, (fl_x, fl_y), (cx - 0.5, cy - 0.5)
    if named == FISHEYE:
        return TransformsLens(*pinhole, "fisheye", (k1, k2, k3, k4))
    if named not in PERSPECTIVE:
        known = ", ".join((*PERSPECTIVE, FISHEYE))
        raise DatasetError(f"{record}: its camera_model is {shown(named)}; a drive folder takes {known}")
    if k4:
        raise DatasetError(
            f"{record}: its k4 is {k4:g}; nerfstudio's k4 is no coefficient of OpenCV's model: undistort the images"
        )
    distortion = (k1, k2, p1, p2, k3)
    return TransformsLens(*pinhole, *(("opencv", distortion) if any(distortion) else ("none", ())))


def _number(
    values: Mapping[str, Any], frame: Mapping[str, Any], key: str, record: str, default: float | None = None
) -> float:
    value = values.get(key, frame.get(key, default))
    if value is None:
        raise DatasetError(f"{record} has no {key}, and neither has the top of the file")
    if not is_number(value) or not abs(value) < 1e9:
        raise DatasetError(f"{record}: its {key} is {shown(value)}; it must be a finite number")
    return float(value)


def unused(values: Mapping[str, Any]) -> list[str]:
    """A sentence for everything that a transforms.json holds and a drive folder does not."""
    frames: Sequence[Mapping[str, Any]] = values["frames"]
    found = []
    if "ply_file_path" in values:
        found.append(
            "ply_file_path is not used: its points are no LiDAR sweeps, and seed points come from images; to add these "
            "points, bring them to metres and set lidar_seed.points_file"
        )
    for key, page in (("mask_path", "docs/masks.md"), ("depth_file_path", "docs/geometry.md")):
        count = sum(key in frame for frame in frames)
        if count:
            found.append(f"{key} of {count} frames is not used (see {page})")
    if any(f"{split}_filenames" in values for split in ("train", "val", "test")):
        found.append("train_filenames, val_filenames and test_filenames are not used: set holdout in the config")
    if values.get("camera_model") == FISHEYE and (values.get("p1") or values.get("p2")):
        found.append("p1 and p2 are not used: OPENCV_FISHEYE has none")
    return found
