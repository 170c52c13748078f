"""The ground, from LiDAR points: its height at a place, and planes that lie on it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

CELL = 1.0
"""Metres: the side of a horizontal cell."""
LOWEST = 5.0
"""Percentile of the heights in a cell that is the ground."""
AROUND, MIN_POINTS = 3.0, 5
"""Metres around a place whose cells count, and the least number of points in them. Cells with as many or more have full
weight."""
NEIGHBOURS, RADIUS, DECAY = 24, 2.5, 1.0
"""Number of cells that a plane is fitted to at most, metres within which they lie, and the standard deviation in metres
of the weight that falls with their distance."""
MIN_NEIGHBOURS = 6
LOW, ABOVE = 0.3, 0.2
"""A cell is left out where its height differs by more than ABOVE metres from this quantile of the heights around: it is
part of something that stands there."""
SAME, ROUNDS = 0.05, 4
"""Metres beyond which a deviation counts linearly (Huber), and rounds of reweighting."""
ROUGH = 0.06
"""Metres of root mean square deviation from a plane beyond which the ground there is no plane."""
NEAR = 0.1
"""Metres from the plane through low points within which points are ground."""


class Planes(NamedTuple):
    """Planes at m places in the world: `places` (metres), unit normals that point up, and offsets along these."""

    places: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 3"]
    offsets: Float[np.ndarray, " m"]


class GroundMap:
    """The ground by the low points in each cell, of `points` (metres, world frame, z up) of what does not move."""

    def __init__(self, points: Float[np.ndarray, "n 3"]):
        cells = np.floor(points[:, :2] / CELL)
        order = np.lexsort((points[:, 2], cells[:, 1], cells[:, 0]))
        starts = np.flatnonzero(np.diff(cells[order], axis=0, prepend=np.nan).any(axis=1))  # NaN counts as a change
        counts = np.diff(starts, append=len(order))
        self._lowest = points[order[starts + (counts * LOWEST / 100.0).astype(int)]].astype(np.float64)
        self._weights = np.minimum(counts, MIN_POINTS)
        self._tree = cKDTree(self._lowest[:, :2])
        self._points = points

    def height(self, place: Float[np.ndarray, "2"]) -> float:
        """The height in metres at a place in the world, the weighted median of the cells around; NaN where it is
        unknown."""
        near = self._tree.query_ball_point(place, AROUND)
        heights = np.repeat(self._lowest[near, 2], self._weights[near])
        return float(np.median(heights)) if len(heights) >= MIN_POINTS else float("nan")

    def planes(self) -> Planes:
        """A plane through the ground around each cell, where it is known and even enough.

        The low points show which points are ground, but they lie below it by the noise of ranges. A plane through them
        is therefore followed by one through the mean of the points nearest to it in the horizontal, within CELL metres
        there and within NEAR metres of it.
        """
        if not len(self._lowest):
            return Planes(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0))
        near, found, _ = _neighbours(self._lowest[:, :2])
        heights = np.sort(np.where(found, self._lowest[near, 2], np.inf), axis=1)
        chosen = (LOW * (found.sum(axis=1) - 1)).astype(int)
        as_low_as_around = np.abs(self._lowest[:, 2] - heights[np.arange(len(heights)), chosen]) < ABOVE
        planes = _planes_through(self._lowest[as_low_as_around])
        if not len(planes.places):
            return planes
        distances, nearest = cKDTree(planes.places).query(self._points[:, :2], distance_upper_bound=CELL)
        inside = np.isfinite(distances)
        points, nearest = self._points[inside].astype(np.float64), nearest[inside]
        close = np.abs((points * planes.normals[nearest]).sum(axis=1) - planes.offsets[nearest]) < NEAR
        points, nearest = points[close], nearest[close]
        counts = np.bincount(nearest, minlength=len(planes.places))
        sums = np.stack([np.bincount(nearest, weights=column, minlength=len(counts)) for column in points.T], axis=1)
        return _planes_through(sums[counts > 0] / counts[counts > 0, None])


def _planes_through(ground: Float[np.ndarray, "k 3"]) -> Planes:
    """A plane through the points around each of these, where they are many and even enough: weighted least squares,
    iteratively reweighted (Huber)."""
    near, found, distances = _neighbours(ground[:, :2])
    offsets = ground[near, :2] - ground[:, None, :2]
    design, heights = np.concatenate([np.ones((*near.shape, 1)), offsets], axis=2), ground[near, 2]
    by_distance = np.where(found, np.exp(-0.5 * np.square(distances / DECAY)), 0.0)
    weights = by_distance
    for _ in range(ROUNDS):
        normal = np.einsum("nk,nki,nkj->nij", weights, design, design) + np.diag([0.0, 1e-2, 1e-2])
        fitted = np.linalg.solve(normal, np.einsum("nk,nki,nk->ni", weights, design, heights)[..., None])[..., 0]
        off = np.abs(np.einsum("nki,ni->nk", design, fitted) - heights)
        weights = by_distance * np.minimum(1.0, SAME / np.maximum(off, 1e-9))
    rough = np.sqrt((weights * off**2).sum(axis=1) / weights.sum(axis=1))
    known = (found.sum(axis=1) >= MIN_NEIGHBOURS) & (rough < ROUGH)
    normals = np.column_stack([-fitted[:, 1:], np.ones(len(fitted))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    through = np.column_stack([ground[:, :2], fitted[:, 0]])
    return Planes(ground[known, :2], normals[known], (normals * through).sum(axis=1)[known])


def _neighbours(
    places: Float[np.ndarray, "k 2"],
) -> tuple[Int[np.ndarray, "k b"], Bool[np.ndarray, "k b"], Float[np.ndarray, "k b"]]:
    """The places near each place, itself included: their rows, whether there are so many, and their distances (metres,
    infinite where there are not)."""
    distances, rows = cKDTree(places).query(places, k=NEIGHBOURS, distance_upper_bound=RADIUS)
    found = np.isfinite(distances)
    return np.where(found, rows, 0), found, distances
