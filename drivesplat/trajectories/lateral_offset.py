"""Lateral offsets from a path, with the heading that a vehicle has while the offset changes."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

HALF_STEP = 0.005
"""Half the interval (seconds) of the finite differences that give speeds."""
FIXED_HEADING_SPEED, FULL_HEADING_SPEED = 1.0, 3.0
"""Speeds in m/s: up to the first a lateral motion leaves the heading unchanged; from the second on the vehicle points
where it moves."""

PosesAt = Callable[[np.ndarray], np.ndarray]
"""Maps seconds (n,) to poses (n, 4, 4), x forward, y left, z up."""


def offset_poses(path: PosesAt, times: np.ndarray, lateral: np.ndarray, lateral_speed: np.ndarray) -> np.ndarray:
    """The poses (n, 4, 4) `lateral` (n,) metres to the left of those of `path` at `times` (n,) in seconds.

    `lateral_speed` (n,) is the derivative of `lateral` in m/s. The vehicle points in its direction of motion, as in a
    lane change.
    """
    poses, yaw = path(times).copy(), np.zeros(len(times))
    if lateral_speed.any():
        before, after = path(times - HALF_STEP), path(times + HALF_STEP)
        velocity = (after - before)[:, :3, 3] / (2 * HALF_STEP)
        forward = np.einsum("ni,ni->n", velocity, poses[:, :3, 0])
        turning = Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
        forward = forward - lateral * turning.as_rotvec()[:, 2] / (2 * HALF_STEP)  # the inside of a bend is shorter
        speed = np.abs(forward)
        weight = np.clip((speed - FIXED_HEADING_SPEED) / (FULL_HEADING_SPEED - FIXED_HEADING_SPEED), 0.0, 1.0)
        yaw = np.arctan2(np.sign(forward) * lateral_speed, speed) * weight**2 * (3.0 - 2.0 * weight)
    poses[:, :3, 3] += lateral[:, None] * poses[:, :3, 1]
    return rotate_yaw(poses, yaw)


def rotate_yaw(poses: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) rotated to the left by `yaw` (n,) radians about their own vertical axes."""
    result = poses.copy()
    result[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", yaw[:, None]).as_matrix()
    return result
