"""The height of the ground along a drive, from the returns of all its scans that do not move.

Far ahead the beams of a LiDAR pass above and below the road. The vehicle comes there later, and sees it from near.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from drivesplat.scene.scan_record import RecordedScan

CELL = 1.0
"""Metres: the side of a cell of the map."""
REACH = 40.0
"""Metres from the sensor within which returns count."""
MAX_SCANS = 100
"""Number of scans, evenly spaced, that are enough for a map."""
LOWEST = 5.0
"""Percentile of the heights in a cell that is the ground."""
AROUND, MIN_RETURNS = 3.0, 5
"""Metres around a place whose cells count, and the least number of returns in them. Cells with as many or more have
full weight."""


class Ground:
    """A map of the ground by the `moving` (n,) of the measured returns of each scan, which are left out."""

    def __init__(self, scans: Sequence[RecordedScan], moving: Sequence[Bool[np.ndarray, " n"]]):
        chosen = np.unique(np.linspace(0, len(scans) - 1, MAX_SCANS).round().astype(int))
        points = np.concatenate([_near(scans[k], moving[k]) for k in chosen])
        cells = np.floor(points[:, :2] / CELL)
        order = np.lexsort((points[:, 2], cells[:, 1], cells[:, 0]))
        starts = np.flatnonzero(np.diff(cells[order], axis=0, prepend=np.nan).any(axis=1))  # NaN counts as a change
        counts = np.diff(starts, append=len(order))
        lowest = order[starts + (counts * LOWEST / 100.0).astype(int)]
        self._heights = points[lowest, 2]
        self._weights = np.minimum(counts, MIN_RETURNS)
        self._cells = cKDTree((cells[lowest] + 0.5) * CELL)

    def height(self, place: Float[np.ndarray, "2"]) -> float:
        """The height in metres at a place in the world, the weighted median of the cells around; NaN where it is
        unknown."""
        near = self._cells.query_ball_point(place, AROUND)
        heights = np.repeat(self._heights[near], self._weights[near])
        return float(np.median(heights)) if len(heights) >= MIN_RETURNS else float("nan")


def _near(scan: RecordedScan, moving: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "m 3"]:
    points = scan.points()[~moving]
    return points[np.linalg.norm(points - scan.sensor_to_world[:3, 3], axis=1) < REACH]
