"""Ghosts: Gaussians that a static model leaves along the path of a moving object."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.scene import Track
from drivesplat.scene.tracks import Box, box_at
from drivesplat.settings.visuals import GhostSettings
from drivesplat.visuals.rendered_view import RenderedView

SAMPLE_DISTANCE = 0.25
"""Metres between the boxes that sample a path."""
MAX_SAMPLE_INTERVAL = 0.25
"""Seconds between them at most."""
MIN_COVERING_OPACITY = 0.05
"""Opacity of the ghosts alone from which they cover a pixel."""


def boxes_along_path(track: Track, interval: float) -> list[Box]:
    """The boxes along a track's path in time, so close that they fill the volume that the object swept.

    `interval` is the scene's key-frame interval in microseconds.
    """
    annotated = (box_at(track, int(time), interval) for time in track.timestamps)
    fastest = max(box.speed for box in annotated if box is not None)
    step = int(1e6 * min(MAX_SAMPLE_INTERVAL, SAMPLE_DISTANCE / max(fastest, 1e-6)))
    times = range(int(track.timestamps[0] - interval / 2), int(track.timestamps[-1] + interval / 2) + 1, step)
    boxes = (box_at(track, time, interval) for time in times)
    return [box for box in boxes if box is not None]


def in_swept_volume(track: Track, interval: float, points: np.ndarray, floor: float = 0.0) -> np.ndarray:
    """Which world points (n, 3) lie in the volume that a track's box swept, its floor raised by `floor` metres: (n,).

    `interval` is the scene's key-frame interval in microseconds.
    """
    inside = np.zeros(len(points), dtype=bool)
    boxes = boxes_along_path(track, interval)
    if not boxes or len(points) == 0:
        return inside
    corners = np.concatenate([box.corners for box in boxes])
    near = np.flatnonzero(((points > corners.min(axis=0)) & (points < corners.max(axis=0))).all(axis=1))
    if len(near) == 0:
        return inside
    tree = cKDTree(points[near])
    for box in boxes:
        around = near[tree.query_ball_point(box.object_to_world[:3, 3], np.linalg.norm(box.size) / 2)]
        inside[around] |= box.contains(points[around], floor=floor)
    return inside


def ghost_figures(gaussians: Gaussians, ghosts: Bool[Tensor, " n"]) -> dict[str, Any]:
    """The number of ghosts, and sum, mean and median of their opacities; mean and median are None without ghosts."""
    opacities = gaussians.opacities[ghosts]
    count = len(opacities)
    return {
        "gaussians": count,
        "opacity_sum": float(opacities.sum()),
        "opacity_mean": float(opacities.mean()) if count else None,
        "opacity_median": float(np.median(opacities.cpu().numpy())) if count else None,
    }


def ghosts_of(view: RenderedView, box: Box, settings: GhostSettings) -> Bool[Tensor, " n"]:
    """The mask of the ghosts of the object at `box`: Gaussians in the volume that its box sweeps during the scene,
    but outside of the box now. Gaussians of dynamic parts move with their objects and are no ghosts."""
    scene, gaussians = view.drive.recording.scene, view.gaussians
    track = scene.track(box.track_id)
    points = gaussians.means.cpu().double().numpy()
    rows = in_swept_volume(track, scene.key_frame_interval, points, settings.clearance) & ~box.contains(points)
    moving = view.drive.model.moving()
    return torch.from_numpy(rows).to(moving.device) & ~moving
