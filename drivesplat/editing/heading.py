"""Driving beside a way: whoever leaves it points where it then drives."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

HALF_STEP = 0.005
"""Seconds to both sides over which speeds are measured."""
STANDS, DRIVES = 1.0, 3.0
"""Speeds in m/s: up to the first, what slides sideways keeps its heading; from the second on it turns fully."""

Poses = Callable[[np.ndarray], np.ndarray]
"""Poses (n, 4, 4), x forward, y left, z up, at seconds (n,)."""


def beside_the_way(way: Poses, at: np.ndarray, lateral: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """The poses (n, 4, 4) `lateral` (n,) metres to the left of those of `way` at the seconds `at` (n,).

    `drift` (n,) is the rate of `lateral` in m/s. Who drifts turns to where it then moves, as it would in driving: a car
    that changes lanes veers.
    """
    poses = way(at).copy()
    if drift.any():
        heading = _veering(way(at - HALF_STEP), poses, way(at + HALF_STEP), lateral, drift)
    else:
        heading = np.zeros(len(at))
    poses[:, :3, 3] += lateral[:, None] * poses[:, :3, 1]
    return turned(poses, heading)


def turned(poses: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) turned to the left by `yaw` (n,) radians about their own vertical axes."""
    result = poses.copy()
    result[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", yaw[:, None]).as_matrix()
    return result


def _veering(
    before: np.ndarray, now: np.ndarray, after: np.ndarray, lateral: np.ndarray, drift: np.ndarray
) -> np.ndarray:
    """By how much (n,) radians to the left who drifts off a way drives otherwise than the way does."""
    velocity = (after - before)[:, :3, 3] / (2 * HALF_STEP)
    forward = np.einsum("ni,ni->n", velocity, now[:, :3, 0])
    turning = Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
    forward = forward - lateral * turning.as_rotvec()[:, 2] / (2 * HALF_STEP)  # the inside of a bend is shorter
    speed = np.abs(forward)
    fully = np.clip((speed - STANDS) / (DRIVES - STANDS), 0.0, 1.0)
    return np.arctan2(np.sign(forward) * drift, speed) * fully**2 * (3.0 - 2.0 * fully)
