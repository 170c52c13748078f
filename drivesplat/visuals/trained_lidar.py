"""Scans of a trained model at the recorded scans of a LiDAR."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.errors import ResultError
from drivesplat.evaluation.scan_evaluation import rendered_scan
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings

MIN_SPEED = 0.5
"""Metres a second below which a scan tells no direction of travel."""


@dataclass(frozen=True)
class TrainedLidar:
    """A trained model with the recorded `scans` of one LiDAR of its scene in order of time. `beam_spread` in
    radians."""

    model: SplatModel
    scene: Scene
    scans: Sequence[RecordedScan]
    beam_spread: tuple[float, float]
    device: torch.device

    @property
    def name(self) -> str:
        """The LiDAR's name."""
        return self.scans[0].lidar

    def render(self, recorded: RecordedScan) -> RenderedScan:
        """What the rays of a recorded scan return. Raises ResultError if the rendering contains NaN or Inf, DeviceError
        if the GPU runs out of memory."""
        with explain_out_of_memory(lambda: len(self.model)):
            found = rendered_scan(self.model, recorded, self.beam_spread, self.device)
        values = (found.ranges, found.drops, *([] if found.intensities is None else [found.intensities]))
        if not all(np.isfinite(array).all() for array in values):
            raise ResultError("a rendered LiDAR scan contains NaN or Inf; delete checkpoint.npz and rerun")
        return found


def open_trained_lidar(
    checkpoint: TrainedCheckpoint, scene: Scene, records: ScanRecords, device_settings: DeviceSettings
) -> TrainedLidar:
    """The model of a checkpoint on the device, with the scans of the LiDAR that has most rays. Raises DeviceError."""
    model, device = open_model(checkpoint, device_settings)
    return TrainedLidar(model, scene, main_scans(records), checkpoint.job.train.scans.beam_spread_rad, device)


def main_scans(records: ScanRecords) -> list[RecordedScan]:
    """The scans of the LiDAR with most rays, the first of equals, in order of time."""
    rays: Counter[str] = Counter()
    for scan in records.scans:
        rays[scan.lidar] += scan.measured.size
    name = max(rays, key=lambda lidar: rays[lidar])
    return sorted((scan for scan in records.scans if scan.lidar == name), key=lambda scan: scan.timestamp)


def heading(scans: Sequence[RecordedScan]) -> float | None:
    """The azimuth (radians) in the sensor's frame of the direction in which the sensor travels; None if it does not."""
    moves = [scan.linear[:2] for scan in scans if np.linalg.norm(scan.linear[:2]) > MIN_SPEED]
    if not moves:
        return None
    x, y = np.sum(moves, axis=0).tolist()
    return float(np.arctan2(y, x))
