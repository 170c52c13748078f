"""Ghosts: the Gaussians that a static model leaves along the way of something that moved."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor

from drivesplat.inspection.rendered_view import Sight
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.scene import Track
from drivesplat.scene.tracks import Box, box_at
from drivesplat.settings.inspection import GhostSettings

STEP = 0.25
"""The box is looked at every so many metres of its way."""
LONGEST_PAUSE = 0.25
"""... and every so many seconds."""
COVERING = 0.05
"""Ghosts cover a pixel where they alone are at least so opaque."""


def boxes_along(track: Track, interval: float) -> list[Box]:
    """The boxes of a track's way over the scene, in time, so close that together they fill the volume it swept.

    `interval` is the scene's key-frame interval in microseconds.
    """
    annotated = (box_at(track, int(time), interval) for time in track.timestamps)
    fastest = max(box.speed for box in annotated if box is not None)
    step = int(1e6 * min(LONGEST_PAUSE, STEP / max(fastest, 1e-6)))
    times = range(int(track.timestamps[0] - interval / 2), int(track.timestamps[-1] + interval / 2) + 1, step)
    boxes = (box_at(track, time, interval) for time in times)
    return [box for box in boxes if box is not None]


def swept(track: Track, interval: float, points: np.ndarray, floor: float = 0.0) -> np.ndarray:
    """Which world points (n, 3) lie in the volume that a track's box swept, its floor raised by `floor` metres: (n,)
    bool."""
    inside = np.zeros(len(points), dtype=bool)
    boxes = boxes_along(track, interval)
    if not boxes or len(points) == 0:
        return inside
    corners = np.concatenate([box.corners for box in boxes])
    near = np.flatnonzero(((points > corners.min(axis=0)) & (points < corners.max(axis=0))).all(axis=1))
    if len(near) == 0:
        return inside
    tree = cKDTree(points[near])
    for box in boxes:
        around = near[tree.query_ball_point(box.object_to_world[:3, 3], np.linalg.norm(box.size) / 2)]
        inside[around] |= box.holds(points[around], floor=floor)
    return inside


@dataclass(frozen=True)
class Ghosts:
    """`rows` (n,) bool: which Gaussians are ghosts of a box at one moment."""

    rows: Bool[Tensor, " n"]

    def figures(self, gaussians: Gaussians) -> dict[str, Any]:
        """How many there are and how opaque: sums and means over them, None where there are none."""
        opacities = gaussians.opacities[self.rows]
        count = len(opacities)
        return {
            "gaussians": count,
            "opacity_sum": float(opacities.sum()),
            "opacity_mean": float(opacities.mean()) if count else None,
            "opacity_median": float(np.median(opacities.cpu().numpy())) if count else None,
        }


def ghosts_of(sight: Sight, box: Box, settings: GhostSettings) -> Ghosts:
    """The ghosts of what is at `box` now: Gaussians in the volume that its box swept over the scene, but outside the
    box. Those of parts that move are none: they go where their objects go."""
    scene, gaussians = sight.drive.recording.scene, sight.gaussians
    track = scene.track(box.track_id)
    points = gaussians.means.cpu().double().numpy()
    rows = swept(track, scene.key_frame_interval, points, settings.clearance) & ~box.holds(points)
    moving = sight.drive.model.moving()
    return Ghosts(torch.from_numpy(rows).to(moving.device) & ~moving)
