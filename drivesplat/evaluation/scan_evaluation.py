"""A model's LiDAR scans against the held-out ones."""

from typing import Any

import torch

from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.model.scans import view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS


@torch.no_grad()
def rendered_scan(
    model: SplatModel, recorded: RecordedScan, beam_spread: tuple[float, float], device: torch.device
) -> RenderedScan:
    """What the rays of a recorded scan return, by a model. `beam_spread` in radians."""
    return model.scan(view_of_scan(recorded, beam_spread, device)).rendered()


def lidar_metrics(
    model: SplatModel, scene: Scene, records: ScanRecords, beam_spread: tuple[float, float], device: torch.device
) -> dict[str, dict[str, Any]]:
    """The metrics of the scans of every held-out group by region: see `scan_metrics`."""
    return {
        group: scan_metrics(
            scene, ((scan, rendered_scan(model, scan, beam_spread, device)) for scan in records.of_group(group))
        )
        for group in HELD_OUT_GROUPS
    }
