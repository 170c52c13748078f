"""Discovered objects as tracks of the scene, and those of a whole drive, compared with annotated objects."""

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivesplat.errors import DatasetError
from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.discover import discovered
from drivesplat.lidar.objects.record import DiscoveredTracks
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan, ScanRecords
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import Box, box_at, boxes_at, boxes_of, moving_tracks
from drivesplat.settings.discover import DiscoverSettings
from drivesplat.settings.tracks import FOUND

log = logging.getLogger(__name__)
NEAR_ENDS_S = 0.15
"""Seconds before an object was first seen, and after it was last seen, for which its motion is known well enough."""
NEAR = 2.0
"""Horizontal metres between an annotated object and the track that finds it."""
HALF = 0.5
"""Fraction of the time for which they have to be near."""
MIN_RETURNS = 10
"""Returns in an annotated box at a key frame from which it is in sight."""
KINDS: dict[str, Callable[[ObjectClass], bool]] = {
    "vehicle": lambda of: of.is_vehicle,
    "human": lambda of: of.is_human,
    "all": lambda of: of.is_dynamic,
}
"""Kinds of objects by the names of their figures."""


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


def tracks_quality(
    scene: Scene, tracks: Sequence[Track], scans: Sequence[RecordedScan], track_ids: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """For each of KINDS: the number of annotated movers in sight, and of discovered tracks; `recall` and `precision`;
    and medians over the key frames at which both are known, in metres: `along_m` and `lateral_m` (along and across the
    annotated box) and `distance_m`, horizontally, of the centres. Figures without any object are None.

    An annotated mover is found where a discovered track is within NEAR for half of the key frames at which it moves in
    sight. A discovered track is right where an annotated object that moves at some time is within NEAR for half of its
    own key frames. `track_ids` are those that `RecordedScan.objects` index.
    """
    seen: dict[str, list[tuple[int, Box]]] = {}  # boxes of annotated movers in sight, with the timestamps, by track
    for scan in (scan for scan in scans if scan.is_key_frame):
        numbers, counts = np.unique(scan.objects_met, return_counts=True)
        returns = {track_ids[n]: int(c) for n, c in zip(numbers, counts, strict=True) if n >= 0}
        for box in boxes_at(scene, scan.timestamp):
            if box.moves and returns.get(box.track_id, 0) >= MIN_RETURNS:
                seen.setdefault(box.track_id, []).append((scan.timestamp, box))
    matches = {track_id: _best(boxes, tracks, scene) for track_id, boxes in seen.items()}
    annotated = moving_tracks(scene)
    right = {}
    for track in tracks:
        near: dict[str, int] = {}
        for timestamp, pose in zip(track.timestamps, track.object_to_world, strict=True):
            for box in boxes_of(annotated, int(timestamp), scene.key_frame_interval):
                if np.linalg.norm(box.object_to_world[:2, 3] - pose[:2, 3]) <= NEAR:
                    near[box.track_id] = near.get(box.track_id, 0) + 1
        right[track.id] = max(near.values(), default=0) >= HALF * len(track.timestamps)
    found = {}
    for kind, belongs in KINDS.items():
        movers = [track_id for track_id, boxes in seen.items() if belongs(boxes[0][1].object_class)]
        own = [track for track in tracks if belongs(track.object_class)]
        pairs = [matches[track_id] for track_id in movers if len(matches[track_id])]
        recalled = sum(len(matches[track_id]) >= HALF * len(seen[track_id]) for track_id in movers)
        offsets = np.abs(np.concatenate(pairs)) if pairs else np.empty((0, 2))
        found[kind] = {
            "movers": len(movers),
            "tracks": len(own),
            "recall": recalled / len(movers) if movers else None,
            "precision": sum(right[track.id] for track in own) / len(own) if own else None,
            "along_m": float(np.median(offsets[:, 0])) if len(offsets) else None,
            "lateral_m": float(np.median(offsets[:, 1])) if len(offsets) else None,
            "distance_m": float(np.median(np.linalg.norm(offsets, axis=1))) if len(offsets) else None,
        }
    return found


def _best(boxes: Sequence[tuple[int, Box]], tracks: Sequence[Track], scene: Scene) -> Float[np.ndarray, "k 2"]:
    """The offsets along and across an annotated object of the track that is near it most often: those within NEAR."""
    best = np.empty((0, 2))
    for track in tracks:
        offsets = []
        for timestamp, box in boxes:
            other = box_at(track, timestamp, scene.key_frame_interval)
            if other is not None:
                apart = other.object_to_world[:2, 3] - box.object_to_world[:2, 3]
                if np.linalg.norm(apart) <= NEAR:
                    offsets.append(box.object_to_world[:2, :2].T @ apart)
        if len(offsets) > len(best):
            best = np.array(offsets)
    return best
