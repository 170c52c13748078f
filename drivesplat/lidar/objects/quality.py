"""Discovered tracks compared with annotated objects that move in sight of the LiDAR."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import Box, box_at, boxes_at, boxes_of, moving_tracks

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
