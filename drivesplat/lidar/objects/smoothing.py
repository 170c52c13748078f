"""Smooth paths through noisy places, with outliers among them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

DEGREE = 3
KNOT_S = 0.5
"""Seconds between knots, or more where places are rarer."""
JERK = 0.0125
"""Weight in s⁶ of the mean squared jerk, for each place, relative to squared deviations of weight 1. It grows with the
number of places, since their errors last: an object that is seen in part is misplaced in many scans, one after the
other."""
ACCELERATION = 0.02
"""Weight in s³ of the integral of squared accelerations. It keeps paths of few places straight."""
OUTLIER = 0.2
"""Metres beyond which a deviation counts linearly (Huber)."""
MIN_SPAN_S = 0.5
"""Seconds that shorter paths count as, in the weight of jerks."""
ROUNDS = 6


@dataclass(frozen=True)
class SmoothPath:
    """A path in the plane, twice continuously differentiable; straight on at constant velocity beyond its ends."""

    spline: BSpline
    first: float
    last: float

    def places(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        within = np.clip(seconds, self.first, self.last)
        return self.spline(within) + (seconds - within)[:, None] * self.velocities(within)

    def velocities(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Metres per second."""
        return self.spline.derivative()(np.clip(seconds, self.first, self.last))

    def accelerations(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """Metres per second squared."""
        return self.spline.derivative(2)(np.clip(seconds, self.first, self.last))


def smooth_path(
    seconds: Float[np.ndarray, " k"], places: Float[np.ndarray, "k 2"], weights: Float[np.ndarray, "k 2"]
) -> SmoothPath:
    """The path that is near `places` (metres) at increasing `seconds`: the least sum of weighted squared deviations, of
    squared accelerations and of squared jerks. `weights` are those of each coordinate."""
    first, last = float(seconds[0]), float(seconds[-1])
    spans = max(1, min(int(np.ceil((last - first) / KNOT_S)), len(seconds)))
    inner = np.linspace(first, max(last, first + 1e-3), spans + 1)
    knots = np.concatenate([np.full(DEGREE, inner[0]), inner, np.full(DEGREE, inner[-1])])
    design = BSpline.design_matrix(np.clip(seconds, inner[0], inner[-1]), knots, DEGREE).toarray()
    straight = ACCELERATION * _integral_of_squares(knots, inner, 2)
    even = JERK * len(seconds) / max(last - first, MIN_SPAN_S) * _integral_of_squares(knots, inner, 3)
    middle = places.mean(axis=0)
    coefficients = np.zeros((design.shape[1], 2))
    for axis in range(2):
        own, wanted = weights[:, axis].copy(), places[:, axis] - middle[axis]
        for _ in range(ROUNDS):
            normal = design.T @ (own[:, None] * design) + straight
            normal += 1e-9 * np.trace(normal) * np.eye(len(normal)) + even
            coefficients[:, axis] = np.linalg.solve(normal, design.T @ (own * wanted))
            off = np.abs(wanted - design @ coefficients[:, axis])
            own = weights[:, axis] * np.minimum(1.0, OUTLIER / np.maximum(off, 1e-9))
    coefficients += middle  # B-splines add up to 1
    return SmoothPath(BSpline(knots, coefficients, DEGREE), first, last)


def _integral_of_squares(knots: np.ndarray, inner: np.ndarray, order: int) -> np.ndarray:
    """The quadratic form of the integral of the squared second or third derivative; exact, as these are at most linear
    between knots."""
    derivative = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE).derivative(order)
    middles, halves = 0.5 * (inner[1:] + inner[:-1]), 0.5 * np.diff(inner)
    values = [derivative(middles + sign * halves / np.sqrt(3.0)) for sign in (-1.0, 1.0)]
    return sum(value.T @ (halves[:, None] * value) for value in values)
