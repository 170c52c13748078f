"""The path of a copy that an edit places: through given points, on the ground beside the ego vehicle's path."""

import numpy as np
from scipy.interpolate import CubicSpline

from drivesplat.settings.edit import Place
from drivesplat.trajectories.motion import Motion

KNOT_HZ = 10.0
"""Poses a second of the motion."""
STANDS_S = 3600.0
"""Seconds for which a copy on a path of one point is present."""
MIN_STEP = 1e-3
"""Metres; a shorter step has no direction."""


def placed_motion(place: Place, ego_to_world: np.ndarray, height: float) -> Motion:
    """The motion of a box `height` metres high along the path of `place`, a spline through its points.

    `ego_to_world` (n, 4, 4) are the ego poses of the drive: its first is the frame of the points, and the nearest to
    each place has the ground's height and slope there. The box faces the direction of its path.
    """
    points = np.array(place.path)
    if len(points) == 1:
        times = points[0, :1] + np.array([0.0, STANDS_S])
        positions = np.repeat(points[:, 1:], 2, axis=0)
    else:
        times = np.linspace(points[0, 0], points[-1, 0], max(2, int(KNOT_HZ * np.ptp(points[:, 0])) + 1))
        positions = CubicSpline(points[:, 0], points[:, 1:], bc_type="natural")(times)
    headings = _headings(positions) + np.radians(place.yaw)
    poses = np.stack([_on_ground(p, h, ego_to_world, height) for p, h in zip(positions, headings, strict=True)])
    return Motion(times, poses, ((0, len(times) - 1),), 0.5 / KNOT_HZ)


def _headings(positions: np.ndarray) -> np.ndarray:
    """The direction (n,) of a path of `positions` (n, 2) in radians; where it stands, that of its last motion."""
    steps = np.gradient(positions, axis=0)
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) > MIN_STEP)
    if not len(moving):
        return np.zeros(len(positions))
    known = moving[np.maximum(np.searchsorted(moving, np.arange(len(positions)), side="right") - 1, 0)]
    return np.arctan2(steps[known, 1], steps[known, 0])


def _on_ground(place: np.ndarray, heading: float, ego_to_world: np.ndarray, height: float) -> np.ndarray:
    """The pose (4, 4) of a box `height` metres high at `place` (2,) in the first ego frame, with the height and tilt
    of the nearest of the ego poses."""
    start = ego_to_world[0]
    at = start[:3, 3] + start[:3, :3] @ np.array([*place, 0.0])
    nearest = ego_to_world[np.argmin(np.linalg.norm(ego_to_world[:, :2, 3] - at[:2], axis=1))]
    up = nearest[:3, 2]
    forward = start[:3, :3] @ np.array([np.cos(heading), np.sin(heading), 0.0])
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    above = at[:2] - nearest[:2, 3]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(left, up), left, up], axis=1)
    pose[:3, 3] = [*at[:2], nearest[2, 3] - above @ up[:2] / up[2]]
    pose[:3, 3] += 0.5 * height * up
    return pose
