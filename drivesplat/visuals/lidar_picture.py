"""The stage `lidar_picture`: held-out LiDAR scans, recorded and rendered."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.evaluation.scan_metrics import scan_metrics, scan_regions
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.visuals.scan_picture import ShownScan, draw_scans
from drivesplat.visuals.trained_lidar import TrainedLidar, heading


def draw_held_out_scans(lidar: TrainedLidar, method: str) -> Figure:
    """A scan of each held-out group, recorded and rendered; a training scan if none is held out. Raises ResultError and
    DeviceError as `TrainedLidar.render` does."""
    shown = []
    for recorded in sample_scans(lidar.scene, lidar.scans):
        rendered = lidar.render(recorded)
        figures = scan_metrics(lidar.scene, [(recorded, rendered)])["all"]
        shown.append(ShownScan(recorded, rendered, f"{scan_label(recorded)}: {figures_label(figures)}"))
    return draw_scans(shown, heading(lidar.scans), f"Scene {lidar.scene.name} · {method} · {lidar.name}")


def sample_scans(scene: Scene, scans: Sequence[RecordedScan]) -> list[RecordedScan]:
    """Of each held-out group the scan with most returns from moving vehicles, or the middle one; of training scans if
    none is held out."""
    groups = [[scan for scan in scans if scan.group == group] for group in HELD_OUT_GROUPS]
    chosen = []
    for group in [group for group in groups if group] or [scans]:
        moving = [int(scan_regions(scene, scan)["moving_vehicle"].sum()) for scan in group]
        chosen.append(group[moving.index(max(moving)) if any(moving) else len(group) // 2])
    return chosen


def scan_label(scan: RecordedScan) -> str:
    """When a scan was recorded, and of which split it is."""
    time = f"Key frame {scan.sample_index}" if scan.is_key_frame else f"{scan.seconds:.2f} s"
    split = f"held out {GROUP_PLACES[scan.group]}" if scan.group in GROUP_PLACES else "training scan"
    return f"{time}, {split}"


def figures_label(figures: dict[str, Any]) -> str:
    """The figures of a scan (`scan_metrics`) in words, those that exist; the reason where there is none."""
    found = []
    if figures["range_error_median_m"] is not None:
        found.append(f"range off by {100.0 * figures['range_error_median_m']:.1f} cm (median)")
    if figures["intensity_rmse"] is not None:
        found.append(f"intensity by {figures['intensity_rmse']:.3f} (RMSE)")
    if figures["drop_accuracy"] is not None:
        found.append(f"{100.0 * figures['drop_accuracy']:.1f} % of returns and drops right")
    return ", ".join(found) or f"no figures, {figures['unavailable']}"
