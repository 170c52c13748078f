"""Drives of a LiDAR alone that stands or moves in an empty round room, written as sweeps of drive folders, and records
of scans made by hand."""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene, Sweep, Track
from drivesplat.scene.sensors import Lidar, Spin
from drivesplat.settings.scans import ScansJob
from helpers.records import recorded_scan

BEAMS = np.radians([-20.0, -10.0, 0.0, 10.0])
STEPS = 144
AZIMUTHS = -np.pi + 2.0 * np.pi * np.arange(STEPS) / STEPS
LIDAR = Lidar("top", BEAMS, STEPS)
KEY_FRAME_US = 500_000
SPIN = Spin(0.1, -0.1, np.pi)


def at(place: Any) -> np.ndarray:
    """A pose (4, 4) without rotation."""
    return rigid(np.eye(3), np.asarray(place, dtype=float))


def room(radius: float = 12.0) -> np.ndarray:
    """Ranges (b, a) of a round room about the sensor; NaN is a ray without a return."""
    return np.full((len(BEAMS), STEPS), radius)


def directions() -> np.ndarray:
    """Unit vectors (b, a, 3) of the pattern."""
    up, around = np.meshgrid(BEAMS, AZIMUTHS, indexing="ij")
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)


def write_returns(path: Path, ranges: np.ndarray, leave_out: tuple[str, ...] = (), **columns: Any) -> str:
    """Writes the returns of `ranges` (b, a) as a sweep of a drive folder, with intensity 0.5 and rings; `columns`
    replaces or adds some."""
    rings, steps = np.nonzero(np.isfinite(ranges))
    points = (directions() * ranges[..., None])[rings, steps]
    x, y, z = points.T
    given = {"x": x, "y": y, "z": z, "intensity": np.full(len(x), 0.5), "ring": rings, **columns}
    np.savez(path, **{name: values for name, values in given.items() if name not in leave_out})
    return str(path)


def sweep_of(path: str, timestamp: int, place: Any = (0.0, 0.0, 0.0), key_frame: bool = True) -> Sweep:
    index = round(timestamp / KEY_FRAME_US)
    return Sweep(path, timestamp, at(place), key_frame, index, f"sweep {timestamp}", "top", "drive")


def scene_of(sweeps: list[Sweep], *tracks: Track, lidar: Lidar = LIDAR) -> Scene:
    """The scene of these sweeps, whose key frames they are at."""
    times = np.array([sweep.timestamp for sweep in sweeps if sweep.is_key_frame], dtype=np.int64)
    return Scene(
        "hand", "mine", "", "", np.zeros(3), times, (), tuple(sweeps), tracks, "drive", 2.0, lidars=(lidar,)
    )  # fmt: skip


def drive_of(folder: Path, scans: list[np.ndarray], **changes: Any) -> Scene:
    """A standing sensor with a sweep of each of these ranges at key frames."""
    paths = [write_returns(folder / f"{i}.npz", ranges) for i, ranges in enumerate(scans)]
    return scene_of([sweep_of(path, i * KEY_FRAME_US) for i, path in enumerate(paths)], **changes)


def track_of(name: str, places: Any, kind: ObjectClass = ObjectClass.CAR, size: Any = (4.0, 2.0, 2.0)) -> Track:
    """A box at world `places` (k, 3) of the key frames from 0."""
    poses = np.stack([at(place) for place in places])
    indices = np.arange(len(poses))
    return Track(
        name, kind, kind.value, np.array(size), indices * KEY_FRAME_US, indices, poses, np.full(len(poses), 4)
    )  # fmt: skip


def job(on_missing: str = "stop", radius: float = 2.5, holdout: dict | None = None, **scans: Any) -> ScansJob:
    """The job of the stage; nothing is held out unless told."""
    nothing = {"every_nth": 0, "last_block": 0}
    return ScansJob.model_validate(
        {"scans": scans, "holdout": holdout or nothing, "own_car_radius": radius, "on_missing": on_missing}
    )


def recorded(
    ranges: np.ndarray, intensity: float | None = 0.5, objects: np.ndarray | None = None, timestamp: int = 0,
    place: Any = (0.0, 0.0, 0.0), measured: np.ndarray | None = None, group: str = "train",
) -> RecordedScan:  # fmt: skip
    """A record of the pattern's rays, all at the timestamp."""
    returned, shape = np.isfinite(ranges), ranges.shape
    up, around = np.meshgrid(BEAMS, AZIMUTHS, indexing="ij")
    rays = ScanRays(around.astype(np.float32), up.astype(np.float32), np.zeros(shape, dtype=np.float32))
    shades = None if intensity is None else np.where(returned, intensity, 0.0).astype(np.float32)
    scan = Scan(rays, returned, np.where(returned, ranges, 0.0).astype(np.float32), shades)
    given = {"lidar": "top", "group": group, "measured": measured, "objects": objects}
    fields = {name: value for name, value in given.items() if value is not None}
    return recorded_scan(scan, at(place), timestamp, round(timestamp / KEY_FRAME_US), **fields)
