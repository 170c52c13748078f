"""The grid of streets: crossings, the streets between them, and what the houses between the streets hide.

Grid frame: metres, x to the east, y to the north, z up, crossing (0, 0) at the origin. Headings count quarter turns to
the left from the east.
"""

from dataclasses import dataclass

import numpy as np

Crossing = tuple[int, int]
"""A crossing by its number along x and along y."""
FORWARD = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Unit vectors of the headings."""
LEFT = np.roll(FORWARD, -1, axis=0)
"""Unit vectors to the left of the headings."""
BUILT = 13.5
"""Distance in metres from the middle of a street beyond which houses stand."""
HIDING = 4.0
"""Metres of a line of sight among houses that hide what is behind them."""
SIGHT_POINTS = 100
"""Number of points of a line of sight that are looked at."""


@dataclass(frozen=True)
class CityBlock:
    """The street from a crossing to its neighbour in the east (`heading` 0) or in the north (1)."""

    crossing: Crossing
    heading: int

    @classmethod
    def between(cls, crossing: Crossing, heading: int) -> "CityBlock":
        """The street that leaves a crossing in any of the four headings."""
        return cls(crossing if heading < 2 else neighbour(crossing, heading), heading % 2)


def neighbour(crossing: Crossing, heading: int) -> Crossing:
    east, north = FORWARD[heading % 4].astype(int).tolist()
    return crossing[0] + east, crossing[1] + north


def hidden(viewer: np.ndarray, points: np.ndarray, block_m: float) -> np.ndarray:
    """Whether houses hide each of `points` (n, 2) from its place in `viewer` (n, 2): (n,) bool. Grid frame."""
    between, shares = points - viewer, np.linspace(0.0, 1.0, SIGHT_POINTS)
    places = (viewer[:, None] + shares[:, None] * between[:, None]) % block_m
    among_houses = (np.abs(places - block_m / 2) < block_m / 2 - BUILT).all(axis=-1)
    return among_houses.mean(axis=1) * np.linalg.norm(between, axis=1) > HIDING
