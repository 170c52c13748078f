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
    headings, steps = np.zeros(len(positions)), np.gradient(positions, axis=0)
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) > MIN_STEP)
    if len(moving):  # where it stands, the direction of its last motion
        known = moving[np.maximum(np.searchsorted(moving, np.arange(len(positions)), side="right") - 1, 0)]
        headings = np.arctan2(steps[known, 1], steps[known, 0])
    start, poses = ego_to_world[0], np.tile(np.eye(4), (len(positions), 1, 1))
    for pose, position, heading in zip(poses, positions, headings + np.radians(place.yaw), strict=True):
        at = start[:3, 3] + start[:3, :3] @ np.array([*position, 0.0])
        nearest = ego_to_world[np.argmin(np.linalg.norm(ego_to_world[:, :2, 3] - at[:2], axis=1))]
        up = nearest[:3, 2]
        forward = start[:3, :3] @ np.array([np.cos(heading), np.sin(heading), 0.0])
        left = np.cross(up, forward)
        left /= np.linalg.norm(left)
        above = at[:2] - nearest[:2, 3]
        pose[:3, :3] = np.stack([np.cross(left, up), left, up], axis=1)
        pose[:3, 3] = [*at[:2], nearest[2, 3] - above @ up[:2] / up[2]]
        pose[:3, 3] += 0.5 * height * up
    return Motion(times, poses, ((0, len(times) - 1),), 0.5 / KNOT_HZ)
