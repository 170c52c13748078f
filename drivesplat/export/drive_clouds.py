"""The LiDAR sweeps of a drive folder, and rendered scans of the same drive, as clouds whose times count from the begin
of the revolution, as in ROS."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt16, UInt32

from drivesplat.errors import DatasetError, ResultError
from drivesplat.io.storage import read_record
from drivesplat.lidar.moved_sensor import steady_motion
from drivesplat.lidar.scans import SensorPoses
from drivesplat.readers.drive.format import Drive
from drivesplat.readers.drive.poses import EgoPath, matrix_of, reach_us
from drivesplat.readers.drive.reader import READER
from drivesplat.readers.drive.sweep_file import beyond_poses
from drivesplat.readers.sweeps import sound_returns, sweep_fault
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan import ScanRays
from drivesplat.scene.scene import Sweep
from drivesplat.trajectories.lateral_offset import PosesAt

log = logging.getLogger(__name__)

RAYS = "npz"
"""The format of rendered scans that has the times of rays."""
NEEDED = ("azimuths", "elevations", "offsets_s", "ranges", "intensities", "returned", "linear", "angular")
"""The arrays of such a file."""


@dataclass(frozen=True, eq=False)
class SweepCloud:
    """The n returns of a revolution: `stamp` (microseconds) is the time at which it begins, `sensor_to_map` the pose
    of the LiDAR at that time, `points` are in the map. None if unknown: `intensity` in [0, 1], `ring` (index of the
    beam), `t` (nanoseconds after the stamp)."""

    stamp: int
    sensor_to_map: Float64[np.ndarray, "4 4"]
    points: Float64[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"] | None
    ring: UInt16[np.ndarray, " n"] | None
    t: UInt32[np.ndarray, " n"] | None


@dataclass(frozen=True, eq=False)
class TimedSweep:
    """A revolution of a LiDAR at a `timestamp` in microseconds: `pose`, sensor to map at that time, where it was
    stated, not computed from the vehicle's; `load` reads its returns."""

    lidar: str
    timestamp: int
    pose: Float64[np.ndarray, "4 4"] | None
    load: Callable[[], SweepCloud]


def recorded_sweeps(drive: Drive, folder: Path, path: PosesAt, origin: Float64[np.ndarray, "3"]) -> list[TimedSweep]:
    """The sweeps of a drive folder in order of time. `path` gives the poses of the ego vehicle in the map, whose origin
    is at `origin` in the drive's world. Sweeps that cannot be motion-compensated at the ends of the drive are left out
    with a warning."""
    ego, found = EgoPath(drive), []
    for record in sorted(drive.sweeps, key=lambda sweep: sweep.timestamp):
        lidar = drive.lidars[record.lidar]
        stated = None if record.lidar_to_world is None else matrix_of(record.lidar_to_world)
        mount = matrix_of(lidar.sensor_to_ego)
        if stated is not None:
            stated[:3, 3] -= origin
        pose = path(np.array([record.timestamp]))[0] @ mount if stated is None else stated
        motion = None if lidar.motion_compensated else ego.motion(record.timestamp, mount, lidar.revolution_s)
        file, token = str(folder / record.file), f"{record.lidar}/{record.timestamp}"
        sweep = Sweep(file, record.timestamp, pose, False, 0, token, record.lidar, READER, motion)
        if motion is not None and (fault := beyond_poses(sweep, reach_us(lidar.revolution_s))):
            log.warning("%s: LiDAR file %s %s; left out", folder, file, fault)
            continue
        found.append(TimedSweep(record.lidar, record.timestamp, stated, partial(_of_file, sweep, path)))
    return found


def _of_file(sweep: Sweep, path: PosesAt) -> SweepCloud:
    """The cloud of a sweep's file. The LiDAR moves during the revolution as the vehicle does."""
    returns = sound_returns(sweep)
    if returns is None:
        raise DatasetError(f"{sweep_fault(sweep)}; restore it, or take it out of drive.json")
    offsets, begin = returns.offsets_s, 0
    if offsets is not None and len(offsets):
        begin = _begin(sweep.timestamp, float(offsets.min()))
    now, first = path(np.array([sweep.timestamp, sweep.timestamp + begin]))
    return SweepCloud(
        sweep.timestamp + begin,
        first @ inverse(now) @ sweep.sensor_to_world,
        apply(sweep.sensor_to_world, returns.points),
        returns.intensity,
        None if returns.rings is None else returns.rings.clip(0, np.iinfo(np.uint16).max).astype(np.uint16),
        None if offsets is None else _nanoseconds(offsets, begin),
    )


def rendered_sweeps(index: Path) -> list[TimedSweep]:
    """The scans that a scans.json lists, in order of time. Raises ResultError where it is missing or damaged, or its
    scans were not written as RAYS."""
    scans = read_record(index, "scan_folder", "scans")["scans"]
    found = []
    try:
        for scan in sorted(scans, key=lambda scan: scan["timestamp"]):
            if RAYS not in scan["files"]:
                raise ResultError(
                    f"{index}: its scans have no times of rays, which an MCAP file holds; add {RAYS!r} to "
                    "export.scan_formats and make it again"
                )
            file, pose = index.parent / scan["files"][RAYS], np.array(scan["sensor_to_world"], dtype=np.float64)
            load = partial(_of_rays, file, scan["timestamp"], pose)
            found.append(TimedSweep(scan["lidar"], scan["timestamp"], pose, load))
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"{index}: not what the rule 'scan_folder' writes ({error}); delete it and rerun") from None
    return found


def _of_rays(file: Path, timestamp: int, pose: np.ndarray) -> SweepCloud:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            values = {name: arrays[name] for name in NEEDED}
    except Exception as error:  # of zipfile, zlib and NumPy
        raise ResultError(f"{file}: not a readable scan ({error}); delete scans.json beside it and rerun") from error
    rays = ScanRays(values["azimuths"], values["elevations"], values["offsets_s"])
    returned, begin = values["returned"], _begin(timestamp, float(rays.offsets_s.min()))
    motion: SensorPoses = steady_motion(pose, values["linear"], values["angular"])
    offsets = rays.offsets_s[returned].astype(np.float64)
    poses = motion(offsets)
    seen = (rays.directions() * values["ranges"][..., None])[returned].astype(np.float64)
    return SweepCloud(
        timestamp + begin,
        motion(np.array([begin * 1e-6]))[0],
        np.einsum("nij,nj->ni", poses[:, :3, :3], seen) + poses[:, :3, 3],
        values["intensities"][returned].clip(0.0, 1.0).astype(np.float32),
        np.nonzero(returned)[0].astype(np.uint16),
        _nanoseconds(offsets, begin),
    )


def _begin(timestamp: int, first_s: float) -> int:
    """The microseconds from a sweep's timestamp to its begin, 0 or less, by the offset of its first point in seconds.
    ROS knows no time before 0."""
    return max(-timestamp, min(0, int(np.floor(first_s * 1e6))))


def _nanoseconds(offsets_s: np.ndarray, begin: int) -> np.ndarray:
    """Seconds after a sweep's timestamp as nanoseconds after `begin`, microseconds after the timestamp."""
    return np.rint(offsets_s * 1e9 - begin * 1e3).clip(0, np.iinfo(np.uint32).max).astype(np.uint32)
