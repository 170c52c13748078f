"""The stage `scan_baselines`: held-out LiDAR scans from other scans, measured as those of a method."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.lidar.scan_baselines import nearest_scan, neighbouring_scans
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS

Baseline = Callable[[RecordedScan, Sequence[RecordedScan]], RenderedScan]
BASELINES: Mapping[str, Baseline] = {"nearest_scan": nearest_scan, "neighbouring_scans": neighbouring_scans}
"""The baselines by their names in metrics.json: a held-out scan from training scans."""
NO_TRAINING_SCAN = "no training scan"


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
