"""The stage `scan_baselines`: held-out LiDAR scans from other scans, without a model, measured as those of a method."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.lidar.moved_sensor import sensor_poses_of
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS

NO_TRAINING_SCAN = "no training scan"
STEPS = 3
"""Iterations to find the ray, and so the time, at which a point is met."""
REACH = 0.75
"""Angle to the nearest ray, in spacings of beams or firings (the wider), beyond which a point is outside a scan."""


def nearest_scan(target: RecordedScan, training: Sequence[RecordedScan]) -> RenderedScan:
    """The training scan nearest in time of the same LiDAR, in the target's rays. Raises ValueError if there is none."""
    return fused([min(_others(target, training), key=lambda scan: abs(scan.timestamp - target.timestamp))], target)


def neighbouring_scans(target: RecordedScan, training: Sequence[RecordedScan]) -> RenderedScan:
    """The last training scan before the target and the first after it, of the same LiDAR, fused in the target's rays;
    one of them at an end of the drive. Raises ValueError if there is none."""
    others = _others(target, training)
    before = [scan for scan in others if scan.timestamp < target.timestamp]
    after = [scan for scan in others if scan.timestamp > target.timestamp]
    found = [min(side, key=lambda s: abs(s.timestamp - target.timestamp)) for side in (before, after) if side]
    return fused(found, target)


def fused(scans: Sequence[RecordedScan], target: RecordedScan) -> RenderedScan:
    """The returns of `scans` as the target's rays meet them: each at its nearest ray, of several the nearest one.
    Rays without any are dropped. Nothing moves but the sensor; rays that are not measured are left out."""
    points = np.concatenate([measured_points(scan) for scan in scans])
    values = [scan.scan.intensities for scan in scans]
    known = all(value is not None for value in values)
    shape = target.scan.rays.shape
    cells, ranges = _met(points, target)
    order = np.argsort(-ranges, kind="stable")  # of several values for one ray numpy keeps the last
    order = order[cells[order] >= 0]
    out, intensities = np.zeros(np.prod(shape)), np.zeros(np.prod(shape))
    out[cells[order]] = ranges[order]
    if known:
        chosen = [value[scan.scan.returned & scan.measured] for scan, value in zip(scans, values, strict=True)]
        intensities[cells[order]] = np.concatenate(chosen)[order]
    drops = (out == 0.0).astype(np.float64).reshape(shape)
    return RenderedScan(out.reshape(shape), drops, intensities.reshape(shape) if known else None)


def measured_points(scan: RecordedScan) -> Float[np.ndarray, "n 3"]:
    """The returns of measured rays in world coordinates, beam by beam."""
    rays, chosen = scan.scan.rays, scan.scan.returned & scan.measured
    local = rays.directions()[chosen].astype(np.float64) * scan.scan.ranges[chosen, None]
    poses = sensor_poses_of(scan)(rays.offsets_s[chosen].astype(np.float64))
    return np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3]


def _others(target: RecordedScan, training: Sequence[RecordedScan]) -> list[RecordedScan]:
    found = [scan for scan in training if scan.lidar == target.lidar and scan.timestamp != target.timestamp]
    if not found:
        raise ValueError(f"no training scan of LiDAR {target.lidar}")
    return found


def _met(points: Float[np.ndarray, "n 3"], target: RecordedScan) -> tuple[np.ndarray, np.ndarray]:
    """The flat index (n,) of the ray that meets each world point, -1 if none does, and its range (n,)."""
    rays = target.scan.rays
    offsets = rays.offsets_s.astype(np.float64).ravel()
    tree = cKDTree(rays.directions().reshape(-1, 3).astype(np.float64))
    beams = np.sort(rays.beam_elevations)
    between_beams = float(np.diff(beams).max()) if len(beams) > 1 else 0.0
    limit = REACH * max(between_beams, 2.0 * np.pi / rays.shape[1])
    sensor = sensor_poses_of(target)
    at = np.full(len(points), float(np.median(offsets)))
    for _ in range(STEPS):
        poses = sensor(at)
        local = np.einsum("nji,nj->ni", poses[:, :3, :3], points - poses[:, :3, 3])
        ranges = np.maximum(np.linalg.norm(local, axis=1), 1e-9)
        _, cells = tree.query(local / ranges[:, None], distance_upper_bound=limit)
        inside = cells < len(offsets)
        at = np.where(inside, offsets[np.where(inside, cells, 0)], at)
    return np.where(inside, cells, -1), ranges


Baseline = Callable[[RecordedScan, Sequence[RecordedScan]], RenderedScan]
BASELINES: Mapping[str, Baseline] = {"nearest_scan": nearest_scan, "neighbouring_scans": neighbouring_scans}
"""The baselines by their names in metrics.json: a held-out scan from training scans."""


def baseline_record(scene: Scene, records: ScanRecords) -> dict[str, Any]:
    """The content of scan_baselines.json without provenance: under `baselines` the metrics of each of BASELINES, by
    held-out group and region (`scan_metrics`). Scans of a LiDAR without training scans are left out."""
    training = records.of_group("train")
    known = {scan.lidar for scan in training}

    def of_group(group: str, baseline: Baseline) -> dict[str, dict[str, Any]]:
        targets = records.of_group(group)
        found = scan_metrics(scene, ((scan, baseline(scan, training)) for scan in targets if scan.lidar in known))
        if targets and not known & {scan.lidar for scan in targets}:
            return {region: {**figures, "unavailable": NO_TRAINING_SCAN} for region, figures in found.items()}
        return found

    measured = {
        name: {group: of_group(group, baseline) for group in HELD_OUT_GROUPS} for name, baseline in BASELINES.items()
    }
    return {"schema": 1, "scene": scene.name, "baselines": measured}
