"""Extrapolation of a track past its ends, robust to annotation noise.

The speed at the very end of an interpolated motion is as inaccurate as two boxes: centimetres of annotation noise would
become metres ten seconds later. Speed and direction are therefore fitted to several annotations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.transition import Transition

FITTED_STEPS = 4
"""Number of steps between annotations to which speed and direction at an end are fitted."""
STANDSTILL_SPEED = 0.5
"""Speed (m/s) below which a track counts as standing at its end; annotation noise of 5 cm stays below it."""
MIN_TURNING_SPEED = 1.0
"""Speed (m/s) from which a change of direction is fitted; below, it is indistinguishable from annotation noise."""
SLOPE_DISTANCE = 20.0
"""Distance (metres) over which the slope at an end is measured; a shorter track is extrapolated at constant height."""


@dataclass(frozen=True)
class EndState:
    """The motion at an end of a track, in the direction of time: `direction` (3,) in the world, of horizontal length 1,
    and the horizontal `speed` along it in m/s, 0 for a standing object."""

    direction: np.ndarray
    speed: float


def end_state(motion: Motion, last: bool) -> EndState:
    """The state of a motion at its last annotation, or at its first.

    Speed and direction are linear fits to the FITTED_STEPS nearest steps between annotations; a standing object has the
    direction of its box. The slope is the height gained per horizontal metre over SLOPE_DISTANCE, 0 on a shorter path.
    """
    first, final = motion.runs[-1 if last else 0]
    indices = np.arange(first, final + 1)
    near = indices[-1 - FITTED_STEPS :] if last else indices[: 1 + FITTED_STEPS]
    end = motion.times[final if last else first]
    speed, direction = _velocity(motion.times[near] - end, motion.object_to_world[near, :2, 3])
    if speed < STANDSTILL_SPEED:
        heading = motion.poses(np.array([end]))[0, :2, 0]
        speed, direction = 0.0, heading / np.linalg.norm(heading)
    positions = motion.object_to_world[indices if last else indices[::-1], :3, 3]
    distances = np.linalg.norm(positions[:, :2] - positions[-1, :2], axis=1)
    far = np.flatnonzero(distances >= SLOPE_DISTANCE)
    slope = float((positions[-1, 2] - positions[far[-1], 2]) / distances[far[-1]]) if len(far) else 0.0
    return EndState(np.array([*direction, slope if last else -slope]), speed)


def _velocity(times: np.ndarray, positions: np.ndarray) -> tuple[float, np.ndarray]:
    """Speed in m/s and direction (2,) at second 0, fitted to `positions` (k, 2) at `times` (k,)."""
    if len(times) < 2:
        return 0.0, np.zeros(2)
    steps, middles = np.diff(positions, axis=0), (times[1:] + times[:-1]) / 2
    lengths = np.linalg.norm(steps, axis=1)
    speeds, angles = lengths / np.diff(times), np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    degree = 1 if len(steps) >= 3 else 0
    speed = _fitted(middles, speeds, degree)
    if speed < STANDSTILL_SPEED:
        return 0.0, np.zeros(2)
    angle = _fitted(middles, angles, degree if speeds.min() > MIN_TURNING_SPEED else 0, lengths)
    return speed, np.array([np.cos(angle), np.sin(angle)])


def _fitted(times: np.ndarray, values: np.ndarray, degree: int, weights: np.ndarray | None = None) -> float:
    """The value at second 0 of a polynomial fitted to `values` (k,) at `times` (k,)."""
    if len(times) == 1:  # of which numpy 1.26 makes a domain of length 0
        return float(values[0])
    return float(Polynomial.fit(times, values, degree, w=weights)(0.0))


def extrapolate(past: np.ndarray, initial: np.ndarray, steady: np.ndarray, over: float) -> np.ndarray:
    """The displacement (n, ...) at `past` (n,) an end, negative before a beginning.

    The derivative changes from `initial` (...) to `steady` (...) over the interval `over`, in the unit of `past`.
    """
    amount = np.abs(past)
    settled = Transition(0.0, over).integral(amount)
    weights = np.sign(past)[:, None] * np.stack([amount - settled, settled], axis=-1)
    return np.tensordot(weights, np.stack([initial, steady]), axes=1)
