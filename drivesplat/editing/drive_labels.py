"""The labels of a rendered drive: the boxes of what its images show, how much of it they show, and its LiDAR points."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from drivesplat.editing.render_plan import ImageRenderPlan
from drivesplat.editing.shown_objects import NONE, SeenObject
from drivesplat.lidar.sweeps import nearest_returns
from drivesplat.readers.nuscenes.write import ImageBox, Labels
from drivesplat.scene.scene import Frame, Scene, Track
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
    frames = zip(drive.scene.frames, drive.views(device), strict=True)
    seen = [(frame, drive.objects.seen_in(view)) for frame, view in frames if frame.is_key_frame]
    shown_by = drive.objects.shown_by({item.id for _, found in seen for item in found})
    _warn_of_traces(drive, shown_by, where)
    levels = _levels(seen)
    key_times = drive.scene.key_frame_timestamps.tolist()

    def kept(tracks: Sequence[Track]) -> tuple[Track, ...]:
        return tuple(_with_visibility(track, levels, key_times) for track in tracks if shown_by[track.id] != NONE)

    tracks = kept(drive.scene.tracks)
    boxes = [ImageBox(frame, item.id, item.corners, item.visible) for frame, found in seen for item in found]
    sources = {item.id: item.source for item in (*drive.objects.actors, *drive.objects.others)}
    points = _lidar_points(scene, {sources[track.id] for track in tracks})
    counts = {track.id: _at_nearest(points[sources[track.id]], track.sample_indices) for track in tracks}
    labels = Labels(shown_by, counts, boxes, trained_until)
    return replace(drive, scene=replace(drive.scene, tracks=tracks), tracks=kept(drive.tracks)), labels


def _warn_of_traces(drive: ImageRenderPlan, shown_by: Mapping[str, str], where: str) -> None:
    others = zip(drive.objects.others, drive.objects.parts, strict=True)
    count = sum(shown_by[item.id] == NONE and not parts for item, parts in others)
    if count:
        log.warning(
            "%s: moving objects without Gaussians of their own in this model: %d. Their boxes are left out, and images "
            "may show traces of them",
            where, count,
        )  # fmt: skip


def _levels(seen: Sequence[tuple[Frame, Sequence[SeenObject]]]) -> dict[tuple[str, int], int]:
    """The level of visibility by object and key frame: that of the image which shows most of the object."""
    levels: dict[tuple[str, int], int] = {}
    for frame, found in seen:
        for item in found:
            key, level = (item.id, frame.sample_index), 1 + int(np.searchsorted(LEVELS, item.visible, side="right"))
            levels[key] = max(level, levels.get(key, 1))
    return levels


def _with_visibility(track: Track, levels: Mapping[tuple[str, int], int], key_times: list[int]) -> Track:
    """A track whose visibility is known at key frames, 1 where no image shows it, and unknown (0) between them."""
    index_of = {time: index for index, time in enumerate(key_times)}
    indices = [index_of.get(time) for time in track.timestamps.tolist()]
    return replace(
        track, visibility=np.array([0 if index is None else levels.get((track.id, index), 1) for index in indices])
    )


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


def _at_nearest(counts: Mapping[int, int], indices: np.ndarray) -> list[int]:
    """The counts at the key frames `indices`, or at the nearest ones that have a count."""
    known = np.array(sorted(counts))
    return [counts[int(known[np.abs(known - index).argmin()])] for index in indices.tolist()]
