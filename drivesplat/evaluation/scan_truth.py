"""A model's LiDAR scans compared with the truth of a synthetic world: from beside the recorded path, and of the street
without the leading car."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int

from drivesplat.evaluation.scan_evaluation import rendered_scan
from drivesplat.evaluation.scan_metrics import ScanPool, scan_metrics
from drivesplat.lidar.moved_sensor import moved, sensor_poses_of
from drivesplat.model.removal import removal_of
from drivesplat.model.scans import view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN
from drivesplat.readers.truth import Truth, TruthScan, truth_arrays
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scan import Scan, ScanRays, wrapped
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import box_at

REMOVAL_RAYS = ("box", "outside")
"""The rays of a scan that the removed car has changed, since they met it, and the others."""


@dataclass(frozen=True)
class ScanTruth:
    """The true scans of a synthetic drive; `path` is that of its truth.json. `rays` are those of the pattern, by
    increasing azimuth, and `order` (a,) their places in the files; `recorded` are the recorded scans by the token of
    their sweep. Returns nearer than `own_car_radius` (metres) are those of the ego vehicle and do not count."""

    truth: Truth
    path: Path
    scene: Scene
    recorded: Mapping[str, RecordedScan]
    rays: ScanRays
    order: Int[np.ndarray, " a"]
    own_car_radius: float

    @classmethod
    def of(cls, truth: Truth, path: Path, scene: Scene, records: ScanRecords, own_car_radius: float) -> "ScanTruth":
        """The true scans of a world that has some. Raises ResultError naming a missing or damaged file."""
        assert truth.pattern is not None
        elevations, azimuths, offsets = truth_arrays(path, truth.pattern, "elevations", "azimuths", "offsets")
        around = wrapped(0.5 * np.pi - azimuths)  # the pattern's count clockwise from y, the sensor's from x to y
        order = np.argsort(around, kind="stable")
        shape = (len(elevations), len(azimuths))
        grids = (around[order], elevations[:, None], offsets[order])
        rays = ScanRays(*(np.broadcast_to(values, shape).astype(np.float32) for values in grids))
        tokens = {(sweep.lidar, sweep.timestamp): sweep.token for sweep in scene.sweeps}
        recorded = {tokens.get((scan.lidar, scan.timestamp), ""): scan for scan in records.scans}
        return cls(truth, path, scene, recorded, rays, order, own_car_radius)

    def scans(
        self, left_m: float = 0.0, without: str | None = None, edit: str | None = None
    ) -> Iterator[tuple[RecordedScan, TruthScan, TruthScan]]:
        """The true scans from so far to the left, without an instance, or after an edit, as recorded ones: those of
        recorded key frames. Each with the true scan itself, and with that of the drive as it was.

        The offset from the recorded pose is that between the true poses, so that errors of recorded poses do not shift
        the rays against their truth.
        """
        indices = {track.id: i for i, track in enumerate(self.scene.tracks) if track.object_class.is_dynamic}
        numbers = np.full(256, NO_OBJECT, dtype=np.int16)
        for number, token in self.truth.instances.items():
            numbers[int(number)] = indices.get(token, NO_OBJECT)
        true_scans = self.truth.scans_of()
        for token, found in self.truth.scans_of(left_m, without, edit).items():
            recorded, true_scan = self.recorded.get(token), true_scans.get(token)
            if recorded is None or true_scan is None:
                continue
            offset = inverse(np.array(true_scan.sensor_to_global)) @ np.array(found.sensor_to_global)
            ranges, shades, instances, returned = self._arrays(found, "range", "intensity", "instance", "returned")
            scan = Scan(
                self.rays, returned, np.where(returned, ranges, 0.0).astype(np.float32),
                np.where(returned, shades, 0.0).astype(np.float32),
            )  # fmt: skip
            known = replace(
                _displaced(recorded, offset),
                scan=scan,
                measured=ranges >= self.own_car_radius,
                objects=np.where(returned, numbers[instances], NO_OBJECT).astype(np.int16),
                blocked=np.zeros(ranges.shape, dtype=bool),
            )
            yield known, found, true_scan

    def met(self, found: TruthScan, *instances: str) -> np.ndarray:
        """The rays (b, a) bool of a true scan that met one of some instances."""
        numbers = [int(number) for number, token in self.truth.instances.items() if token in instances]
        (met,) = self._arrays(found, "instance")
        return np.isin(met, numbers)

    def _arrays(self, found: TruthScan, *names: str) -> list[np.ndarray]:
        """Arrays (b, a) of a scan's file, by increasing azimuth."""
        return [array[:, self.order] for array in truth_arrays(self.path, found.file, *names)]


def _displaced(recorded: RecordedScan, offset: np.ndarray) -> RecordedScan:
    """A recorded scan from a sensor that is `offset` (4, 4) away in its own frame."""
    if np.allclose(offset, np.eye(4), atol=1e-9):
        return recorded
    sensor = sensor_poses_of(recorded)
    return moved(recorded, lambda offsets: sensor(offsets) @ offset)


def scan_truth_metrics(
    model: SplatModel, known: ScanTruth, margin: float, beam_spread: tuple[float, float], device: torch.device
) -> dict[str, dict[str, Any]]:
    """The figures of LiDAR in `lateral` and `removal` of a method's metrics. `margin` (metres) is that around the box
    of a car that the model does not know as an object; `beam_spread` in radians."""
    lateral = lateral_scan_metrics(model, known, beam_spread, device)
    removal = removal_scan_metrics(model, known, margin, beam_spread, device)
    return {
        "lateral": {offset: {"lidar": figures} for offset, figures in lateral.items()},
        "removal": {"lidar": removal} if removal else {},
    }


def lateral_scan_metrics(
    model: SplatModel, known: ScanTruth, beam_spread: tuple[float, float], device: torch.device
) -> dict[str, dict[str, Any]]:
    """The figures of the scans from beside the path by their offset, in metres to the left (negative: to the right),
    each by region: see `scan_metrics`. `beam_spread` in radians."""
    found = {}
    for left_m in known.truth.left_of_scans:
        scans = (scan for scan, _, _ in known.scans(left_m))
        pairs = ((scan, rendered_scan(model, scan, beam_spread, device)) for scan in scans)
        found[str(float(left_m))] = scan_metrics(known.scene, pairs)
    return found


@torch.no_grad()
def removal_scan_metrics(
    model: SplatModel, known: ScanTruth, margin: float, beam_spread: tuple[float, float], device: torch.device
) -> dict[str, Any] | None:
    """The scans without the leading car compared with those of the street without it, over all key frames in which rays
    met the car: the figures (`ScanPool.figures`) of these rays (`box`) and of the others (`outside`). `not_removed`
    holds those of the unchanged model. None without truth."""
    leading = known.truth.leading
    if leading is None:
        return None
    pools = {key: {rays: ScanPool() for rays in REMOVAL_RAYS} for key in ("removed", "not_removed")}
    measured = False
    track, interval = known.scene.track(leading), known.scene.key_frame_interval
    for scan, _, before in known.scans(without=leading):
        shadow, box = known.met(before, leading), box_at(track, scan.timestamp, interval) if track else None
        if box is None or not shadow.any():
            continue
        measured = True
        view = view_of_scan(scan, beam_spread, device)
        gaussians = model.at(view.time, SCAN)
        kept = gaussians[~removal_of(model, gaussians, box, margin).removed]
        for key, shown in (("removed", kept), ("not_removed", gaussians)):
            rendered = model.scan(view, gaussians=shown).rendered()
            for name, rays in zip(REMOVAL_RAYS, (shadow, ~shadow), strict=True):
                pools[key][name].add(scan, rendered, rays & scan.measured)
    if not measured:
        return None
    figures = {key: {name: pool.figures() for name, pool in of_rays.items()} for key, of_rays in pools.items()}
    return {**figures["removed"], "not_removed": figures["not_removed"]}
