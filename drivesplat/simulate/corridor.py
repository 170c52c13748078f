"""What is in the way on a path, and how drivers brake for it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from drivesplat.settings.simulate import TrafficSettings


class InTheWay(NamedTuple):
    """The nearest object on a path: its `index`, the metres from the beginning of the path to its `near` edge, and the
    cosine between its heading and the direction of the path there."""

    index: int
    near: float
    cosine: float


def first_in_the_way(
    path: Float64[np.ndarray, "p 2"],
    centres: Float64[np.ndarray, "k 2"],
    headings: Float64[np.ndarray, "k 2"],
    sizes: Float64[np.ndarray, "k 2"],
    width: float,
) -> InTheWay | None:
    """The first of k objects that a body of this `width` would meet on a path, points in equal steps (metres); None
    where it meets none. An object is a rectangle: its centre, its heading as a unit vector, and its length and width.
    Objects whose centre is behind the beginning of the path do not count."""
    if len(path) < 2 or not len(centres):
        return None
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    directions = np.gradient(path, axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    nearest = np.linalg.norm(centres[:, None] - path, axis=2).argmin(axis=1)
    own, offset = directions[nearest], centres - path[nearest]
    signed = (headings * own).sum(axis=1)
    cosine, sine = np.abs(signed), np.sqrt(np.maximum(1.0 - signed**2, 0.0))
    half_length = 0.5 * (sizes[:, 0] * cosine + sizes[:, 1] * sine)
    half_width = 0.5 * (sizes[:, 0] * sine + sizes[:, 1] * cosine)
    aside = np.abs(own[:, 0] * offset[:, 1] - own[:, 1] * offset[:, 0])
    position = along[nearest] + (own * offset).sum(axis=1)
    met = np.flatnonzero((aside < half_width + 0.5 * width) & (position > 0.0))
    if not len(met):
        return None
    near = position - half_length
    index = int(met[near[met].argmin()])
    return InTheWay(index, float(near[index]), float(signed[index]))


def braking_for(
    gap: float, speed: float, approach: float, time_gap: float, acceleration: float, driver: TrafficSettings
) -> float:
    """The deceleration (m/s²) by which the intelligent driver model (Treiber, Hennecke and Helbing 2000) answers what
    is `gap` metres s ahead and comes nearer by `approach` dv (m/s): a (s* / s)^2, where s* = s0 + max(0, v T + v dv /
    (2 sqrt(a b))). `time_gap` T and `acceleration` a are the driver's own; s0 and b are those of the settings."""
    if not np.isfinite(gap):
        return 0.0
    wanted = driver.standstill_gap + max(
        speed * time_gap + speed * approach / (2.0 * np.sqrt(acceleration * driver.braking)), 0.0
    )
    return float(acceleration * (wanted / max(gap, 0.1)) ** 2)
