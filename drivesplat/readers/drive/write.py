"""Writes a scene as a drive folder: images, sweeps and a drive.json that is read back as the same scene."""

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.io.storage import write_json
from drivesplat.readers.drive.format import FILE, Drive
from drivesplat.readers.files import link_or_copy
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.scene import UNPOSED, Frame, Scene, Sweep, Track
from drivesplat.scene.sensors import Camera, LidarReturns

log = logging.getLogger(__name__)

VISIBLE = (None, 0.2, 0.5, 0.7, 0.9)
"""The visible share that is written for each level of visibility: the middle of the level; None for level 0."""
OPTIONAL = {"intensity": "intensity", "rings": "ring", "offsets_s": "time"}
"""Columns of a sweep's file by the fields of its returns."""


def write_drive(scene: Scene, folder: Path, licence: str = "") -> Path:
    """Writes a scene into an empty `folder`: hard links to its images, or copies, its sweeps as .npz, and drive.json.
    Missing images and sweeps are left out with a warning. Returns the path of drive.json.

    Raises DatasetError where the folder holds anything, or where the scene has none of its images or no poses.

    >>> from drivesplat.scene.scene import read_scene
    >>> write_drive(read_scene("results/0001/scene.json"), Path("mine/0001"))
    PosixPath('mine/0001/drive.json')
    """
    require_empty(folder)
    if scene.poses == UNPOSED:
        raise DatasetError(
            f"scene {scene.name} has no poses; write scene_refined.json, where they are estimated from the images"
        )
    frames = [
        (frame, f"images/{frame.camera}/{frame.timestamp}{Path(frame.image_path).suffix}")
        for frame in scene.frames
        if Path(frame.image_path).is_file()
    ]
    if not frames and scene.frames:
        raise DatasetError(
            f"scene {scene.name}: none of its {len(scene.frames)} images is there "
            f"(first: {scene.frames[0].image_path}); "
            "paths are relative to the folder in which the workflow ran"
        )
    sweeps = [
        (sweep, f"sweeps/{sweep.lidar}/{sweep.timestamp}.npz") for sweep in scene.sweeps if not sweep_fault(sweep)
    ]
    missing = len(scene.frames) - len(frames), len(scene.sweeps) - len(sweeps)
    if any(missing):
        log.warning("scene %s: %d images and %d sweeps are missing and left out", scene.name, *missing)
    for frame, name in frames:
        link_or_copy(Path(frame.image_path), folder / name)
    for sweep, name in sweeps:
        write_sweep(folder / name, read_returns(sweep))
    path = folder / FILE
    _write_checked(path, drive_record(scene, frames, sweeps, licence))
    return path


def write_record(path: Path, scene: Scene, rendered: dict[str, Any]) -> None:
    """Writes the drive.json of a scene whose images and sweeps lie in the folder of `path`, marked as `rendered`."""

    def inside(file: str) -> str:
        return Path(file).relative_to(path.parent).as_posix()

    frames = [(frame, inside(frame.image_path)) for frame in scene.frames]
    sweeps = [(sweep, inside(sweep.path)) for sweep in scene.sweeps]
    _write_checked(path, {**drive_record(scene, frames, sweeps, ""), "rendered": rendered})


def write_sweep(path: Path, returns: LidarReturns) -> None:
    """Writes the returns of a sweep as .npz."""
    columns = dict(zip("xyz", returns.points.astype(np.float32).T, strict=True))
    columns |= {name: values for field, name in OPTIONAL.items() if (values := getattr(returns, field)) is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **columns)


def _write_checked(path: Path, record: dict[str, Any]) -> None:
    Drive.model_validate(record)
    write_json(path, record)


def require_empty(folder: Path) -> None:
    """Raises DatasetError if `folder` is a file, or holds anything."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder} is not empty; name a new folder")


def drive_record(
    scene: Scene, frames: Iterable[tuple[Frame, str]], sweeps: Iterable[tuple[Sweep, str]], licence: str
) -> dict[str, Any]:
    """The content of drive.json for a scene, with these images and sweeps by path."""
    written, rolling = list(frames), {camera.name for camera in scene.cameras if camera.readout_s}
    return {
        "format": "drivesplat drive",
        "version": 1,
        "description": scene.description,
        "licence": licence or scene.licence,
        "origin": scene.origin.tolist(),
        "cameras": {camera.name: _camera(camera, written) for camera in scene.cameras},
        "lidars": {
            lidar.name: {
                "sensor_to_ego": pose_record(np.eye(4)),
                "beam_elevations": None if lidar.beam_elevations is None else lidar.beam_elevations.tolist(),
                "azimuth_steps": lidar.azimuth_steps,
            }
            for lidar in scene.lidars
        },
        "key_frames": scene.key_frame_timestamps.tolist(),
        "frames": [
            {
                "camera": frame.camera,
                "timestamp": frame.timestamp,
                "file": name,
                "key_frame": frame.is_key_frame,
                "camera_to_world": pose_record(frame.camera_to_world),
                "ego_to_world": pose_record(frame.ego_to_world),
                "camera_velocity": _velocity(frame) if frame.camera in rolling else None,
                "readout_middle_s": frame.readout_middle_s if frame.camera in rolling else 0.0,
            }
            for frame, name in written
        ],
        "sweeps": [
            {
                "lidar": sweep.lidar,
                "timestamp": sweep.timestamp,
                "file": name,
                "lidar_to_world": pose_record(sweep.sensor_to_world),
            }
            for sweep, name in sweeps
        ],
        "tracks": [_track(track) for track in scene.tracks],
    }


def pose_record(matrix: np.ndarray) -> dict[str, Any]:
    """A pose with its rotation as a matrix, which loses nothing."""
    return {"translation": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist()}


def _camera(camera: Camera, frames: Iterable[tuple[Frame, str]]) -> dict[str, Any]:
    first = next((frame for frame, _ in frames if frame.camera == camera.name), None)
    mount = np.eye(4) if first is None else first.camera_to_ego
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.intrinsics.tolist(),
        "sensor_to_ego": pose_record(mount),
        "readout_s": camera.readout_s,
        "readout_direction": camera.readout_direction,
    }


def _velocity(frame: Frame) -> list[float] | None:
    return None if frame.camera_velocity is None else frame.camera_velocity.tolist()


def _track(track: Track) -> dict[str, Any]:
    annotations = zip(track.timestamps.tolist(), track.object_to_world, track.visibility.tolist(), strict=True)
    return {
        "id": track.id,
        "class": track.object_class.value,
        "category": track.category,
        "size": track.size.tolist(),
        "poses": [
            {"timestamp": time, **pose_record(pose), "visibility": VISIBLE[level]} for time, pose, level in annotations
        ],
    }
