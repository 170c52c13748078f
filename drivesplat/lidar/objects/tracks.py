"""Discovered objects as tracks of the scene, and those of a whole drive."""

import logging
from collections.abc import Sequence

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.discover import discovered
from drivesplat.lidar.objects.quality import tracks_quality
from drivesplat.lidar.objects.record import DiscoveredTracks
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.discover import DiscoverSettings
from drivesplat.settings.tracks import FOUND

log = logging.getLogger(__name__)

NEAR_ENDS_S = 0.15
"""Seconds before an object was first seen, and after it was last seen, for which its motion is known well enough."""


def discovered_tracks(
    scene: Scene, records: ScanRecords, settings: DiscoverSettings, threads: int = 1
) -> DiscoveredTracks:
    """The moving objects of a scene by the scans of one LiDAR, without provenance, compared with annotated ones if any
    are known. Raises DatasetError where the scene has no scan, or none of the LiDAR that the settings name."""
    lidar, scans = searched(scene, records, settings.lidar)
    if len(scans) < 2:
        log.warning("LiDAR %s has a single scan: nothing shows which objects move", lidar)
    tracks = tuple(tracks_of(scene, discovered(scans, threads))) if len(scans) > 1 else ()
    log.info("%d moving objects in %d scans of LiDAR %s", len(tracks), len(scans), lidar)
    quality = tracks_quality(scene, tracks, scans, records.tracks) if scene.tracks else None
    return DiscoveredTracks(lidar, len(scans), tracks, quality)


def searched(scene: Scene, records: ScanRecords, wanted: str | None) -> tuple[str, list[RecordedScan]]:
    """The LiDAR that is searched, and its scans in order of time: the `wanted` one, or that with the most returns."""
    by_lidar: dict[str, list[RecordedScan]] = {}
    for scan in sorted(records.scans, key=lambda scan: scan.timestamp):
        by_lidar.setdefault(scan.lidar, []).append(scan)
    if not by_lidar:
        raise DatasetError(f"scene {scene.name} has no LiDAR scan; moving objects cannot be discovered without LiDAR")
    if wanted is not None and wanted not in by_lidar:
        known = ", ".join(sorted(by_lidar))
        raise DatasetError(f"scene {scene.name} has no scan of discover.lidar {wanted}; choose one of {known}")
    returns = {name: sum(int(scan.scan.returned.sum()) for scan in own) for name, own in by_lidar.items()}
    chosen = max(returns, key=lambda name: returns[name]) if wanted is None else wanted
    return chosen, by_lidar[chosen]


def tracks_of(scene: Scene, objects: Sequence[Discovered]) -> list[Track]:
    """Objects as tracks at the key frames in which they were seen; without those that no key frame saw."""
    times = np.array([scene.seconds(timestamp) for timestamp in scene.key_frame_timestamps])
    found = []
    for item in objects:
        seen = (times >= item.seconds[0] - NEAR_ENDS_S) & (times <= item.seconds[-1] + NEAR_ENDS_S)
        if seen.any():
            samples = np.flatnonzero(seen)
            of_class = item.object_class
            found.append(
                Track(
                    f"{FOUND}{len(found) + 1:04d}", of_class, f"discovered.{of_class.value}", item.size,
                    scene.key_frame_timestamps[samples], samples, item.poses(times[samples]), np.zeros_like(samples),
                )
            )  # fmt: skip
    return found
