"""Accelerations, jerks and turning of a driven path, with nuPlan's bounds.

The point that accelerates is the middle of the rear axle, as in NAVSIM v1. It does not slip: its velocity is the signed
speed v along the heading psi, so its acceleration in the vehicle's frame is (dv/dt, v dpsi/dt).

A derivative is that of a polynomial fitted by least squares to a window around each step: the filter of Savitzky and
Golay, with orders and windows as in nuPlan (whose steps are 0.1 s), on the real times of the steps. Windows are
centred, so the first and last steps, by half a window each, have no value.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

BOUNDS = {
    "lon_acceleration": (-4.05, 2.40),
    "lat_acceleration": (-4.89, 4.89),
    "jerk": (0.0, 8.37),
    "lon_jerk": (-4.13, 4.13),
    "yaw_rate": (-0.95, 0.95),
    "yaw_acceleration": (-1.93, 1.93),
}
"""nuPlan's bounds of comfort, m/s², m/s³, rad/s and rad/s²; NAVSIM and HUGSIM have the same."""


@dataclass(frozen=True)
class DerivativeFilter:
    """The first or second `derivative` of a polynomial of an `order` that is fitted to a window of `span` seconds."""

    order: int
    span: float
    derivative: int = 1

    def window(self, seconds: Float64[np.ndarray, " n"]) -> int:
        """Steps of a window: odd, at least order + 1, and no more than there are; 0 where these are too few."""
        n = len(seconds)
        if n <= self.order:
            return 0
        half = max(round(0.5 * self.span / float(np.median(np.diff(seconds)))), (self.order + 1) // 2)
        window = min(2 * half + 1, n - 1 + n % 2)
        return window if window > self.order else 0

    def __call__(
        self, values: Float64[np.ndarray, " n"], seconds: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, " n"]:
        """The derivative at each step; NaN where the window does not fit."""
        found, window = np.full(len(values), np.nan), self.window(seconds)
        if window:
            half = window // 2
            middle = slice(half, len(values) - half)
            times = np.lib.stride_tricks.sliding_window_view(seconds, window) - seconds[middle, None]
            scale = np.abs(times).max(axis=1, keepdims=True)
            powers = (times / scale)[..., None] ** np.arange(self.order + 1)
            normal = np.swapaxes(powers, 1, 2)
            windows = np.lib.stride_tricks.sliding_window_view(values, window) - values[middle, None]
            fitted = np.linalg.solve(normal @ powers, normal @ windows[..., None])[:, self.derivative, 0]
            factorial = 2.0 if self.derivative == 2 else 1.0
            found[middle] = factorial * fitted / scale[:, 0] ** self.derivative
        return found


ACCELERATION = DerivativeFilter(order=3, span=0.8)
"""Of speeds. nuPlan smooths accelerations, which its states have, with order 2 over 8 steps."""
JERK = DerivativeFilter(order=2, span=1.4)
"""Of accelerations: nuPlan's order and 15 steps."""
YAW_RATE = DerivativeFilter(order=2, span=0.4)
"""Of headings: nuPlan's order and 5 steps."""
YAW_ACCELERATION = DerivativeFilter(order=3, span=0.4, derivative=2)
"""Of headings: nuPlan's order and 5 steps."""


def comfort_columns(
    seconds: Float64[np.ndarray, " n"], ego_to_world: Float64[np.ndarray, "n 4 4"], speed: Float64[np.ndarray, " n"]
) -> dict[str, Float64[np.ndarray, " n"]]:
    """The quantities of BOUNDS at each step, and `comfortable`: 1 where all that are known keep their bounds, else 0;
    NaN where nothing is known.

    `jerk` is the length of the derivative of the acceleration in the vehicle's frame, as passengers feel it.
    """
    yaw = np.unwrap(np.arctan2(ego_to_world[:, 1, 0], ego_to_world[:, 0, 0]))
    yaw_rate = YAW_RATE(yaw, seconds)
    lon_acceleration, lat_acceleration = ACCELERATION(speed, seconds), speed * yaw_rate
    lon_jerk, lat_jerk = _of_known(JERK, lon_acceleration, seconds), _of_known(JERK, lat_acceleration, seconds)
    columns = {
        "lon_acceleration": lon_acceleration,
        "lat_acceleration": lat_acceleration,
        "jerk": np.hypot(lon_jerk, lat_jerk),
        "lon_jerk": lon_jerk,
        "yaw_rate": yaw_rate,
        "yaw_acceleration": YAW_ACCELERATION(yaw, seconds),
    }
    known = np.stack([~np.isnan(columns[name]) for name in BOUNDS])
    broken = np.stack([(columns[name] < low) | (columns[name] > high) for name, (low, high) in BOUNDS.items()])
    columns["comfortable"] = np.where(known.any(axis=0), 1.0 - broken.any(axis=0), np.nan)
    return columns


def comfort_extremes(columns: dict[str, Float64[np.ndarray, " n"]]) -> dict[str, dict[str, float | bool | None]]:
    """Of each quantity of BOUNDS its smallest and largest value, and whether both are within the bounds; null where it
    is not known at any step."""
    found: dict[str, dict[str, float | bool | None]] = {}
    for name, (low, high) in BOUNDS.items():
        values = columns[name][~np.isnan(columns[name])]
        found[name] = {"min": None, "max": None, "within": None}
        if len(values):
            least, most = float(values.min()), float(values.max())
            found[name] = {"min": least, "max": most, "within": low <= least and most <= high}
    return found


def _of_known(derivative: DerivativeFilter, values: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """A derivative of values (n,) that are NaN at the first and last steps."""
    found, known = np.full(len(values), np.nan), ~np.isnan(values)
    found[known] = derivative(values[known], seconds[known])
    return found
