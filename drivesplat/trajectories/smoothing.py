"""Annotated motions without the noise of their annotations.

Boxes wander by centimetres from one annotation to the next, as no vehicle does: a box follows the pitch of the ego
vehicle, the returns of one sweep, or the hand that drew it. Held-out images then show the object a few pixels from
where its box is, and no correction that is learned from other images can know.

The estimate is a smoothing spline of third order: a motion whose jerk is white noise, seen through annotations with
errors that last `ERROR_DURATION` (Särkkä, Bayesian Filtering and Smoothing, 2013, chapter 12). Exact annotations of a
vehicle that steers and brakes change by millimetres, at any rate.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from drivesplat.trajectories.motion import Motion

POSITION_ERROR, ANGLE_ERROR = 0.1, 0.03
"""Expected errors of annotations: metres, radians. Residuals beyond them count less and less (Huber)."""
ERROR_DURATION = 0.3
"""Seconds over which the error of an annotation persists. Closer annotations are not independent."""
JERK = np.array([5.0, 5.0, 0.5])
"""Expected change of the acceleration within a second along the world's axes (m/s²): vehicles and people steer and
brake, but follow the road up and down."""
TURNING_JERK = np.array([1.0, 0.1, 0.1])
"""Expected change of the angular acceleration within a second (rad/s²): of heading, pitch and roll."""
MIN_INTERVAL = 0.01
"""Seconds between annotations below which their third differences are lost in rounding."""
ROUNDS = 5
"""Rounds of reweighted least squares."""
ORDER = 3
"""Order of the derivative that is white noise."""


def smoothed(motion: Motion) -> Motion:
    """The motion with smoothed annotations. Runs of at most ORDER annotations, and those with some closer than
    MIN_INTERVAL, stay as they are."""
    poses = motion.object_to_world.copy()
    for first, last in motion.runs:
        own = slice(first, last + 1)
        times, given = motion.times[own], poses[own]
        if last - first < ORDER or np.diff(times).min() < MIN_INTERVAL:
            continue
        given[:, :3, 3] = smooth(times, given[:, :3, 3], POSITION_ERROR, JERK)
        angles = np.unwrap(Rotation.from_matrix(given[:, :3, :3]).as_euler("ZYX"), axis=0)
        angles = smooth(times, angles, ANGLE_ERROR, TURNING_JERK)
        given[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    return replace(motion, object_to_world=poses)


def smooth(
    times: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"], error: float, jerk: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "n d"]:
    """The smoothing spline of each column of `values` at increasing `times` (seconds, more than ORDER of them), with
    the expected `error` of a value and the expected change of its second derivative within a second, `jerk`."""
    bands = _normal_bands(*_third_differences(times), len(times))
    precise = np.clip(np.gradient(times) / ERROR_DURATION, None, 1.0) / error**2
    result = values.copy()
    for column in range(values.shape[1]):
        own, weights = values[:, column], precise
        for _ in range(ROUNDS):
            system = bands / jerk[column] ** 2
            system[-1] += weights
            result[:, column] = solveh_banded(system, weights * own)
            weights = precise * error / np.maximum(np.abs(result[:, column] - own), error)
    return result


def _third_differences(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The weights (n - 3, 4) of four consecutive values in the third derivative there, and the seconds (n - 3,) for
    which each stands."""
    around = np.stack([times[i : len(times) - ORDER + i] for i in range(ORDER + 1)], axis=1)
    differences = around[:, :, None] - around[:, None] + np.eye(ORDER + 1)  # 1 on the diagonal, a factor of no effect
    return 6.0 / differences.prod(axis=2), (around[:, -1] - around[:, 0]) / ORDER


def _normal_bands(rows: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """The upper bands (4, count), as `solveh_banded` takes them, of the sum of the outer products of `rows`."""
    bands = np.zeros((ORDER + 1, count))
    for i in range(ORDER + 1):
        for j in range(i, ORDER + 1):
            bands[ORDER + i - j, j : j + len(rows)] += weights * rows[:, i] * rows[:, j]
    return bands
