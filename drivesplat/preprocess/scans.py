"""The stage `scans`: the revolutions of all LiDARs as rays, with what each returned and which object it met.

Resolved once, so that training, metrics and pictures agree on which rays there are, which returned, and which say
nothing.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.lidar.objects_met import TrackedBoxes
from drivesplat.lidar.scans import SensorPoses, mean_velocity, scan_of, sensor_poses
from drivesplat.lidar.unmeasured import blocked_rays, measured_rays
from drivesplat.readers.outline import without_scans
from drivesplat.readers.sweeps import read_returns, read_scan
from drivesplat.scene.scan import Scan
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene, Sweep, place_of
from drivesplat.scene.sensors import Lidar, LidarReturns, Spin
from drivesplat.scene.splits import Group, sweep_groups
from drivesplat.settings.scans import ScanSettings, ScansJob

log = logging.getLogger(__name__)

MAX_DEVIATION = 0.005
"""Share of the firings of a revolution by which one may have more or fewer."""


@dataclass(frozen=True)
class FoundScan:
    """A sweep with its split, its scan, and the sensor's poses about it in its frame at the timestamp."""

    sweep: Sweep
    group: Group
    scan: Scan
    poses: SensorPoses


def scan_records(scene: Scene, job: ScansJob) -> ScanRecords:
    """The scans of a scene, without provenance, in order of LiDAR and time.

    Raises DatasetError where the scene has no LiDAR; and, unless `on_missing` is 'warn', naming the first sweep that is
    missing, damaged, or says too little to tell its rays.
    """
    boxes, records = TrackedBoxes.of_scene(scene), []
    known = {lidar.name: lidar for lidar in scene.lidars}
    for name in dict.fromkeys(sweep.lidar for sweep in scene.sweeps):
        found = _found(scene, known.get(name, Lidar(name)), job)
        measured = measured_rays([item.scan for item in found], job.own_car_radius)
        in_training = [item.group == "train" for item in found]
        blocked = blocked_rays(
            [item.scan for item in found], [item.sweep.sensor_to_world for item in found], in_training
        )
        for item, rays, hidden in zip(found, measured, blocked, strict=True):
            sweep, scan, seconds = item.sweep, item.scan, scene.seconds(item.sweep.timestamp)
            offsets = scan.rays.offsets_s.astype(np.float64)
            linear, angular = mean_velocity(item.poses, float(offsets.min()), float(offsets.max()))
            objects = np.full(scan.returned.shape, NO_OBJECT, dtype=np.int16)
            points, origins = world_returns(scan, sweep.sensor_to_world, item.poses)
            objects[scan.returned] = boxes.met(points, origins, seconds + offsets[scan.returned])
            record = RecordedScan(
                sweep.lidar, sweep.timestamp, seconds, sweep.sample_index, sweep.is_key_frame, item.group,
                sweep.sensor_to_world, linear, angular, scan, np.ascontiguousarray(rays), objects,
                np.ascontiguousarray(hidden),
            )  # fmt: skip
            records.append(record)
    if not records:
        raise DatasetError(without_scans(scene.name))
    count = sum(record.scan.returned.size for record in records)
    log.info(
        "%d scans with %d rays: %.1f %% return, %.1f %% say nothing, %.1f %% are blocked by the vehicle",
        len(records), count, 100.0 * sum(int(record.scan.returned.sum()) for record in records) / count,
        100.0 * sum(int((~record.measured).sum()) for record in records) / count,
        100.0 * sum(int(record.blocked.sum()) for record in records) / count,
    )  # fmt: skip
    return ScanRecords(records, [track.id for track in scene.tracks])


def spin_of(lidar: Lidar, settings: ScanSettings) -> Spin | None:
    """How a LiDAR goes round: as the settings say, or as its dataset does."""
    spin = settings.spin
    if spin is None or spin == "dataset":
        return lidar.spin if spin else None
    start_s = -spin.timestamp * spin.revolution_s
    return Spin(spin.revolution_s, start_s, float(np.radians(spin.start_azimuth_deg)), spin.clockwise)


def _found(scene: Scene, lidar: Lidar, job: ScansJob) -> list[FoundScan]:
    """The scans of a LiDAR in order of time."""
    groups = zip(scene.sweeps, sweep_groups(scene, job.holdout), strict=True)
    wanted = [
        (sweep, group)
        for sweep, group in sorted(groups, key=lambda item: item[0].timestamp)
        if sweep.lidar == lidar.name and (sweep.is_key_frame or job.scans.sweeps)
    ]
    found, missing = [], 0
    for sweep, group in wanted:
        poses = sensor_poses(sweep, scene.sweeps)
        try:
            found.append(FoundScan(sweep, group, resolved_scan(sweep, lidar, poses, job.scans), poses))
        except DatasetError as error:
            if job.on_missing == "stop":
                raise
            missing += 1
            log.log(logging.WARNING if missing == 1 else logging.DEBUG, "%s; left out", error)
    if missing:
        log.warning("%d of %d sweeps of LiDAR %s give no scan; they are left out", missing, len(wanted), lidar.name)
    return found


def resolved_scan(sweep: Sweep, lidar: Lidar, poses: SensorPoses, settings: ScanSettings) -> Scan:
    """The scan of a sweep: its file's rays, or those rebuilt from its returns. Raises DatasetError naming the sweep's
    file where there is none."""
    spin = spin_of(lidar, settings)
    scan = read_scan(sweep, spin)
    if scan is None:
        try:
            returns = read_returns(sweep)
            steps = settings.azimuth_steps or firings(returns, lidar.azimuth_steps)
            scan = scan_of(returns, replace(lidar, azimuth_steps=steps), poses, spin)
        except DatasetError as error:
            raise DatasetError(
                str(error) if sweep.path in str(error) else f"{place_of(sweep)}: LiDAR file {sweep.path}: {error}"
            ) from error
    if not scan.returned.any():
        raise DatasetError(f"{place_of(sweep)}: LiDAR file {sweep.path} has no return of a ray")
    return scan


def firings(returns: LidarReturns, stated: int | None) -> int | None:
    """The firings of a revolution: those `stated` for the LiDAR, or, where the times of returns tell a number that
    deviates by at most MAX_DEVIATION, that one, since sensors do not go round evenly."""
    if stated is None or returns.offsets_s is None:
        return stated
    times = np.unique(returns.offsets_s)
    if len(times) < 2:
        return stated
    counted = round(float((times[-1] - times[0]) / np.median(np.diff(times)))) + 1
    return counted if abs(counted - stated) <= MAX_DEVIATION * stated else stated


def world_returns(scan: Scan, sensor_to_world: np.ndarray, poses: SensorPoses) -> tuple[np.ndarray, np.ndarray]:
    """The returns (n, 3) of a scan in world coordinates, beam by beam, and the sensor's positions (n, 3) at their
    times."""
    offsets = scan.rays.offsets_s[scan.returned].astype(np.float64)
    at = sensor_to_world @ poses(offsets)
    return np.einsum("nij,nj->ni", at[:, :3, :3], scan.points().astype(np.float64)) + at[:, :3, 3], at[:, :3, 3]
