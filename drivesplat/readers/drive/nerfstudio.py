"""A transforms.json of nerfstudio as a drive folder.

Its world must have z up, as nerfstudio's, and its scale must be stated. It knows no vehicle: the ego frame is taken to
be under one camera, on the ground, level on average, with x in the direction in which this camera looks.
"""

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.conversion import pose_at, write_folder
from drivesplat.readers.drive.nerfstudio_file import (
    TransformsFrame,
    TransformsLens,
    applied_transform,
    clean_name,
    content_of,
    shots_of,
    unused,
)
from drivesplat.readers.drive.write import pose_record
from drivesplat.scene.rigid import inverse, rigid

MAX_CAMERAS = 32
MIN_UPRIGHT = 0.5
"""Minimum mean z of the directions in which cameras have their tops."""
MIN_LEVEL = 0.2
"""Minimum sine of the angle between the vertical and the direction in which the camera of the ego frame looks."""


@dataclass(frozen=True)
class Scale:
    """What a transforms.json does not say. None: not stated, which is refused."""

    metres_per_unit: float | None
    """Metres of a unit of `transform_matrix`."""
    seconds_per_time: float | None
    """Seconds of a unit of `timestamp` or `time`: 1e-6 for microseconds."""
    camera_height: float | None
    """Metres of the ego camera above the ground."""
    hz: float | None = None
    """Images a second of each camera, for files without times."""
    ego_camera: str | None = None
    """The camera that looks ahead; None: the first of the file."""
    undo_applied_transform: bool = False
    """Whether the world is that before `applied_transform`."""


def convert(path: Path, folder: Path, scale: Scale, licence: str = "") -> tuple[Path, list[str]]:
    """Writes a transforms.json as an empty drive folder: every image with a pose of its own. Returns the path of
    drive.json, and a sentence for all that is left out.

    Raises DatasetError naming a value that cannot be, or the part of `scale` that is not stated.
    """
    values = content_of(path)
    metres, height = _stated(scale, values)
    shots = _in_metres(shots_of(values, path, scale.seconds_per_time, scale.hz), values, path, scale, metres)
    cameras = grouped(shots)
    ego_camera = scale.ego_camera or next(iter(cameras))
    if ego_camera not in cameras:
        raise DatasetError(f"{path} has no camera {ego_camera!r}; there are: {', '.join(cameras)}")
    mounts = mounted(cameras, ego_camera, height)
    files = {
        (name, shot.time): f"images/{name}/{shot.time}{shot.path.suffix}"
        for name, of_camera in cameras.items()
        for shot in of_camera
    }
    record = {
        "format": "drivesplat drive",
        "version": 1,
        "description": "from a transforms.json of nerfstudio",
        "licence": licence,
        "cameras": {
            name: {
                "width": lens.width,
                "height": lens.height,
                "K": [[lens.focal[0], 0.0, lens.centre[0]], [0.0, lens.focal[1], lens.centre[1]], [0.0, 0.0, 1.0]],
                "sensor_to_ego": pose_record(mounts[name]),
                "distortion": {"model": lens.model, "coefficients": list(lens.coefficients)},
            }
            for name, lens in ((name, of_camera[0].lens) for name, of_camera in cameras.items())
        },
        "frames": [
            {
                "camera": name,
                "timestamp": shot.time,
                "file": files[name, shot.time],
                "camera_to_world": pose_record(shot.camera_to_world),
            }
            for name, of_camera in cameras.items()
            for shot in of_camera
        ],
    }
    images = {files[name, shot.time]: shot.path for name, of_camera in cameras.items() for shot in of_camera}
    return write_folder(folder, record, images), unused(values)


def _stated(scale: Scale, values: dict[str, Any]) -> tuple[float, float]:
    """Metres per unit, and metres above the ground. Raises DatasetError where one of these two is not stated, or a part
    of the scale is no positive number."""
    applied = values.get("applied_scale")
    hint = f"; the file says that its source's units were multiplied by {applied!r}" if applied is not None else ""
    for value, needed, what in (
        (
            scale.metres_per_unit,
            True,
            "--metres-per-unit: the metres of a unit of transform_matrix (1 if metres)" + hint,
        ),
        (scale.seconds_per_time, False, "--seconds-per-time: the seconds of a unit of timestamp or time"),
        (scale.hz, False, "--hz: the images a second of each camera"),
        (scale.camera_height, True, "--camera-height: the metres of the camera that looks ahead above the ground"),
    ):
        if value is None and needed:
            raise DatasetError(f"a transforms.json does not say it, so state {what}")
        if value is not None and not 0 < value < np.inf:
            raise DatasetError(f"it must be a positive number, not {value:g}: {what}")
    assert scale.metres_per_unit and scale.camera_height
    return scale.metres_per_unit, scale.camera_height


def _in_metres(
    shots: Sequence[TransformsFrame], values: dict[str, Any], path: Path, scale: Scale, metres: float
) -> list[TransformsFrame]:
    """The shots with poses in metres, in a world with z up."""
    undo = inverse(applied_transform(values, path)) if scale.undo_applied_transform else np.eye(4)
    found = []
    for shot in shots:
        pose = undo @ shot.camera_to_world
        found.append(replace(shot, camera_to_world=rigid(pose[:3, :3], pose[:3, 3] * metres)))
    up = -np.mean([shot.camera_to_world[:3, 1] for shot in found], axis=0)
    if up[2] < MIN_UPRIGHT:
        remedy = "leave out" if scale.undo_applied_transform else "try"
        also = f", or {remedy} --undo-applied-transform" if "applied_transform" in values else ""
        raise DatasetError(
            f"{path}: the tops of its images point to ({up[0]:.2f}, {up[1]:.2f}, {up[2]:.2f}) on average; z must be "
            f"up: rotate transform_matrix{also}"
        )
    return found


def grouped(shots: Sequence[TransformsFrame]) -> dict[str, list[TransformsFrame]]:
    """The shots of each camera, in time order. A camera is what `camera`, `camera_id` or `camera_name` says, otherwise
    the images of a folder that have the same intrinsics.

    Raises DatasetError naming shots of one camera with different intrinsics or equal times, and for too many cameras.
    """
    common = os.path.commonpath([shot.path.absolute().parent for shot in shots])
    lenses: dict[str, list[TransformsLens]] = {}
    cameras: dict[tuple[str, int], list[TransformsFrame]] = {}
    for shot in shots:
        inside = Path(os.path.relpath(shot.path.absolute().parent, common)).as_posix()
        name = shot.camera or clean_name(Path(common).name if inside == "." else inside) or "camera"
        known = lenses.setdefault(name, [])
        if shot.lens not in known:
            known.append(shot.lens)
        if shot.camera is not None and len(known) > 1:
            first = cameras[name, 0][0].record.rpartition(": ")[2]
            raise DatasetError(f"{shot.record}: its intrinsics are not those of {first}, of the same camera {name}")
        cameras.setdefault((name, known.index(shot.lens)), []).append(shot)
    if len(cameras) > MAX_CAMERAS:
        raise DatasetError(
            f"{shots[0].record.rpartition(': ')[0]}: its images have {len(cameras)} different intrinsics; a camera has "
            f"one for all of its images, and a drive at most {MAX_CAMERAS} cameras: calibrate them as one"
        )
    named = {
        f"{name}_{number}" if len(lenses[name]) > 1 else name: sorted(found, key=lambda shot: shot.time)
        for (name, number), found in cameras.items()
    }
    if len(named) < len(cameras):
        raise DatasetError(
            f"{shots[0].record.rpartition(': ')[0]}: two cameras have one name; rename {', '.join(named)}"
        )
    for name, found in named.items():
        for one, other in pairwise(found):
            if one.time == other.time:
                first = one.record.rpartition(": ")[2]
                raise DatasetError(f"{other.record}: it has the time of {first}, of the same camera {name}")
    return named


def mounted(cameras: dict[str, list[TransformsFrame]], ego_camera: str, height: float) -> dict[str, np.ndarray]:
    """Camera to ego (4, 4) of each camera; the ego camera is `height` above the origin.

    Raises DatasetError where the ego camera looks up or down.
    """
    poses = np.stack([shot.camera_to_world for shot in cameras[ego_camera]])
    up = poses[:, 2, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < MIN_LEVEL:
        raise DatasetError(f"camera {ego_camera} looks up or down; name one that looks ahead with --ego-camera")
    forward /= np.linalg.norm(forward)
    mount = rigid(np.stack([forward, np.cross(up, forward), up]), np.array([0.0, 0.0, height]))
    times = np.array([shot.time for shot in cameras[ego_camera]], dtype=np.int64)
    ego = poses @ inverse(mount)
    mounts = {ego_camera: mount}
    for name, shots in cameras.items():
        if name != ego_camera:
            nearest = min(shots, key=lambda shot: int(np.abs(times - shot.time).min()))
            mounts[name] = inverse(pose_at(times, ego, nearest.time)) @ nearest.camera_to_world
    return mounts


def add_command(commands: Any) -> None:
    """Adds `from-nerfstudio` to the subparsers of the command line."""
    parser = commands.add_parser(
        "from-nerfstudio",
        help="write a transforms.json of nerfstudio as a drive folder",
        description="Writes a transforms.json of nerfstudio as a drive folder.",
    )
    parser.add_argument("transforms", type=Path, help="the transforms.json")
    parser.add_argument("folder", type=Path, help="the drive folder, new or empty")
    parser.add_argument("--metres-per-unit", type=float, help="metres of a unit of transform_matrix; 1 if metres")
    parser.add_argument(
        "--seconds-per-time", type=float, help="seconds of a unit of timestamp or time; 1e-6 if microseconds"
    )
    parser.add_argument("--hz", type=float, help="images a second of each camera, if the file has no times")
    parser.add_argument("--camera-height", type=float, help="metres of the ego camera above the ground")
    parser.add_argument("--ego-camera", help="the camera that looks ahead; by default the first one")
    parser.add_argument(
        "--undo-applied-transform", action="store_true", help="use the world before the file's applied_transform"
    )
    parser.add_argument("--licence", default="", help="who may use the recording, and for what")
    parser.set_defaults(run=_run)


def _run(asked: argparse.Namespace) -> int:
    scale = Scale(
        asked.metres_per_unit, asked.seconds_per_time, asked.camera_height, asked.hz, asked.ego_camera,
        asked.undo_applied_transform,
    )  # fmt: skip
    written, left_out = convert(asked.transforms, asked.folder, scale, asked.licence)
    for sentence in left_out:
        print(f"warning: {sentence}")
    print(written)
    return 0
