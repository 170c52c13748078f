"""Metrics of rendered LiDAR scans over a group of recorded ones, as the measuring protocol defines them.

Only rays that are `measured` count. Rays with a return belong to a region by the box that the return lies in at the
ray's time; rays without one lie in no box, and belong to `all` and `static`.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool

from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import box_at

SCAN_REGIONS = ("all", "static", "moving_vehicle")
MIN_RAYS = 100
"""A region with fewer measured rays in a group has no figures."""
WORST_SHARE = 0.05
"""Share of the largest range errors that `range_error_mean_m` leaves out."""
FIGURES = (
    "range_error_median_m",
    "range_error_mean_m",
    "range_error_median_sq",
    "intensity_rmse",
    "drop_accuracy",
    "chamfer_m",
)


def scan_metrics(
    scene: Scene, scans: Iterable[tuple[RecordedScan, RenderedScan]], chamfer: bool = True
) -> dict[str, dict[str, Any]]:
    """The metrics of a group of scans by region: FIGURES, `rays` and `returns`, pooled over all scans.

    Errors of range and intensity are over rays that return in both scans. A figure that does not exist is None, and
    `unavailable` says why. `chamfer_m` is the mean of two mean distances: from recorded to nearest rendered points of
    the same scan and region, and back; points are in the sensor's frame at their rays' times. Without `chamfer`, which
    takes most of the time, it is None.
    """
    pooled = {region: ScanPool(chamfer) for region in SCAN_REGIONS}
    for recorded, rendered in scans:
        if rendered.ranges.shape != recorded.scan.rays.shape:
            raise ValueError(f"a rendered scan of {rendered.ranges.shape} rays for one of {recorded.scan.rays.shape}")
        for region, rays in scan_regions(scene, recorded).items():
            pooled[region].add(recorded, rendered, rays)
    return {region: pool.figures() for region, pool in pooled.items()}


def scan_regions(scene: Scene, recorded: RecordedScan) -> dict[str, Bool[np.ndarray, "b a"]]:
    """The measured rays of each region of SCAN_REGIONS. A vehicle moves by its box at the sweep's timestamp."""
    moving = []
    for index in np.unique(recorded.objects[recorded.objects != NO_OBJECT]).tolist():
        box = box_at(scene.tracks[index], recorded.timestamp, scene.key_frame_interval)
        if box is not None and box.object_class.is_vehicle and box.moves:
            moving.append(index)
    return {
        "all": recorded.measured,
        "static": recorded.measured & (recorded.objects == NO_OBJECT),
        "moving_vehicle": recorded.measured & np.isin(recorded.objects, moving),
    }


class ScanPool:
    """What the scans of a group add up to in a region."""

    def __init__(self, chamfer: bool = True) -> None:
        self.chamfer = chamfer
        self.rays = self.returns = self.right_drops = 0
        self.errors: list[np.ndarray] = []
        self.squared_intensity, self.intensities = 0.0, 0
        self.distances = np.zeros(2)
        self.points = np.zeros(2, dtype=np.int64)

    def add(self, recorded: RecordedScan, rendered: RenderedScan, rays: np.ndarray) -> None:
        """Adds the `rays` (b, a) of a scan."""
        scan, returned = recorded.scan, recorded.scan.returned
        both = rays & returned & rendered.returned
        self.rays += int(rays.sum())
        self.returns += int((rays & returned).sum())
        self.right_drops += int((rays & (returned == rendered.returned)).sum())
        self.errors.append(np.abs(rendered.ranges[both].astype(np.float64) - scan.ranges[both]))
        if scan.intensities is not None and rendered.intensities is not None:
            error = rendered.intensities[both].astype(np.float64) - scan.intensities[both]
            self.squared_intensity += float((error**2).sum())
            self.intensities += int(both.sum())
        if not self.chamfer:
            return
        from scipy.spatial import cKDTree  # here: the report imports this module, and scipy takes long

        directions = scan.rays.directions().astype(np.float64)
        clouds = [
            directions[rays & there] * ranges[rays & there, None]
            for there, ranges in ((returned, scan.ranges), (rendered.returned, rendered.ranges))
        ]
        if all(map(len, clouds)):
            for i, (cloud, other) in enumerate((clouds, clouds[::-1])):
                self.distances[i] += float(cKDTree(other).query(cloud)[0].sum())
                self.points[i] += len(cloud)

    def figures(self) -> dict[str, Any]:
        """The figures of the region; None where they do not exist, with the reason as `unavailable`."""
        counts = {"rays": self.rays, "returns": self.returns}
        if self.rays < MIN_RAYS:
            return {**dict.fromkeys(FIGURES), **counts, "unavailable": f"fewer than {MIN_RAYS} measured rays"}
        errors, reasons = np.sort(np.concatenate(self.errors)), []
        found: dict[str, Any] = {**dict.fromkeys(FIGURES), "drop_accuracy": self.right_drops / self.rays}
        if len(errors):
            kept = errors[: int(np.ceil((1.0 - WORST_SHARE) * len(errors)))]
            found["range_error_median_m"] = float(np.median(errors))
            found["range_error_mean_m"] = float(kept.mean())
            found["range_error_median_sq"] = float(np.median(errors**2))
        else:
            reasons.append("no ray returns" if not self.returns else "no ray returns in both scans")
        if self.intensities:
            found["intensity_rmse"] = float(np.sqrt(self.squared_intensity / self.intensities))
        elif len(errors):
            reasons.append("there is no intensity")
        if self.points.all():
            found["chamfer_m"] = float((self.distances / self.points).mean())
        return {**found, **counts, **({"unavailable": "; ".join(reasons)} if reasons else {})}
