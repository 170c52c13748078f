"""Smooth paths through noisy places, with outliers among them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline

DEGREE = 3
KNOT_S = 0.5
"""Seconds between knots, or more where places are rarer."""
STIFFNESS = 0.0125
"""Weight of squared jerks (m/s³), in places of weight 1 (m²). Their errors last: where an object is seen in part they
are those of many places one after the other, so that more places per second say hardly more."""
OUTLIER = 0.2
"""Metres beyond which a deviation counts linearly (Huber)."""
ROUNDS = 6


@dataclass(frozen=True)
class Path:
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


def smooth_path(
    seconds: Float[np.ndarray, " k"], places: Float[np.ndarray, "k 2"], weights: Float[np.ndarray, "k 2"]
) -> Path:
    """The path that is near `places` at increasing `seconds`, by the least sum of weighted squared deviations and of
    squared jerks: neither a constant velocity nor a constant acceleration costs anything. `weights` are those of each
    coordinate."""
    first, last = float(seconds[0]), float(seconds[-1])
    spans = max(1, min(int(np.ceil((last - first) / KNOT_S)), len(seconds)))
    inner = np.linspace(first, max(last, first + 1e-3), spans + 1)
    knots = np.concatenate([np.full(DEGREE, inner[0]), inner, np.full(DEGREE, inner[-1])])
    design = BSpline.design_matrix(np.clip(seconds, inner[0], inner[-1]), knots, DEGREE).toarray()
    penalty = STIFFNESS * len(seconds) / max(last - first, 1e-3) * _jerks(knots, inner)
    coefficients = np.zeros((design.shape[1], 2))
    for axis in range(2):
        own = weights[:, axis].copy()
        for _ in range(ROUNDS):
            normal = design.T @ (own[:, None] * design) + penalty
            normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
            coefficients[:, axis] = np.linalg.solve(normal, design.T @ (own * places[:, axis]))
            off = np.abs(places[:, axis] - design @ coefficients[:, axis])
            own = weights[:, axis] * np.minimum(1.0, OUTLIER / np.maximum(off, 1e-9))
    return Path(BSpline(knots, coefficients, DEGREE), first, last)


def _jerks(knots: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The quadratic form of the integral of squared third derivatives, which are constant between knots."""
    count = len(knots) - DEGREE - 1
    values = BSpline(knots, np.eye(count), DEGREE).derivative(3)(0.5 * (inner[:-1] + inner[1:]))
    return values.T @ (np.diff(inner)[:, None] * values)
