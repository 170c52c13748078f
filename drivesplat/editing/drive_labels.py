"""The labels of a rendered drive: the boxes of what its images show, how much of it they show, and its LiDAR points."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from drivesplat.editing.render_plan import ImageRenderPlan
from drivesplat.editing.shown_objects import NONE
from drivesplat.lidar.sweeps import nearest_returns
from drivesplat.readers.nuscenes.write import ImageBox, Labels
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import in_box

log = logging.getLogger(__name__)

LEVELS = (0.4, 0.6, 0.8)
"""The visible shares between nuScenes' levels of visibility, which count from 1."""


def labelled(
    scene: Scene, drive: ImageRenderPlan, trained_until: int | None, device: torch.device, where: str
) -> tuple[ImageRenderPlan, Labels]:
    """The drive with the boxes of what it shows, their visibility known at key frames, and the labels of its images.

    An object without Gaussians of its own keeps its boxes if the background shows it in an image of a key frame. Warns,
    starting with `where`, of moving objects whose boxes are left out. `trained_until` (microseconds; None: unknown) is
    the time of the last training image. Raises DeviceError where the GPU runs out of memory.
    """
    frames, objects = zip(drive.scene.frames, drive.views(device), strict=True), drive.objects
    seen = [(frame, objects.seen_in(view)) for frame, view in frames if frame.is_key_frame]
    shown_by = objects.shown_by({item.id for _, found in seen for item in found})
    others = zip(objects.others, objects.parts, strict=True)
    traces = sum(shown_by[item.id] == NONE and not parts for item, parts in others)
    if traces:
        log.warning(
            "%s: moving objects without Gaussians of their own in this model: %d. Their boxes are left out, and images "
            "may show traces of them",
            where, traces,
        )  # fmt: skip
    levels: dict[tuple[str, int], int] = {}  # by object and key frame, in the image that shows most of the object
    for frame, found in seen:
        for item in found:
            key, level = (item.id, frame.sample_index), 1 + int(np.searchsorted(LEVELS, item.visible, side="right"))
            levels[key] = max(level, levels.get(key, 1))
    index_of = {time: index for index, time in enumerate(drive.scene.key_frame_timestamps.tolist())}

    def shown(tracks: Sequence[Track]) -> tuple[Track, ...]:
        """Those that the drive shows, with a visibility of 1 at key frames without them, and of 0 between."""
        kept = []
        for track in (track for track in tracks if shown_by[track.id] != NONE):
            indices = (index_of.get(time) for time in track.timestamps.tolist())
            known = [0 if index is None else levels.get((track.id, index), 1) for index in indices]
            kept.append(replace(track, visibility=np.array(known)))
        return tuple(kept)

    tracks = shown(drive.scene.tracks)
    boxes = [ImageBox(frame, item.id, item.corners, item.visible) for frame, found in seen for item in found]
    sources = {item.id: item.source for item in (*objects.actors, *objects.others)}
    points = _lidar_points(scene, {sources[track.id] for track in tracks})
    counts = {}
    for track in tracks:  # a key frame without a count has that of the nearest one
        own = points[sources[track.id]] or {0: 0}  # an inserted object was not measured
        known = np.array(sorted(own))
        counts[track.id] = [own[int(known[np.abs(known - index).argmin()])] for index in track.sample_indices.tolist()]
    labels = Labels(shown_by, counts, boxes, trained_until)
    return replace(drive, scene=replace(drive.scene, tracks=tracks), tracks=shown(drive.tracks)), labels


def _lidar_points(scene: Scene, ids: set[str]) -> dict[str, dict[int, int]]:
    """The number of returns in the recorded boxes of tracks, by key frame: those of each LiDAR's sweep that is nearest
    to it. Sweeps that cannot be read have none."""
    counts: dict[str, dict[int, int]] = {name: {} for name in ids}
    for index, time in enumerate(scene.key_frame_timestamps.tolist()):
        boxes = [(track, np.flatnonzero(track.sample_indices == index)) for track in scene.tracks if track.id in ids]
        returns = [
            nearest_returns([sweep for sweep in scene.sweeps if sweep.lidar == name], time, scene.key_frame_interval)
            for name in sorted({sweep.lidar for sweep in scene.sweeps})
        ]
        points = np.concatenate([np.zeros((0, 3)), *(found for found in returns if found is not None)])
        for track, at in boxes:
            if len(at):
                counts[track.id][index] = int(in_box(points, track.object_to_world[at[0]], track.size).sum())
    return counts
