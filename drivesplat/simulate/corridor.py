"""What is in the way on a path."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64


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
