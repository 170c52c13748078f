"""Places that stay occupied: nothing moves through a wall or a hedge.

A cell of a horizontal grid is occupied in a scan where a return that does not move lies in it, between LOW and HIGH
above the ground. Where scans saw it occupied before an object passed and again afterwards, the object did not pass.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.clusters import Cluster
from drivesplat.scene.scan_record import RecordedScan

CELL = 0.4
"""Metres: the side of a cell."""
LOW, HIGH = 0.5, 1.6
"""Metres above the ground between which a return is in the way of any object."""
GROUND_CELL = 1.0
"""Metres: the side of squares in which the ground counts as level."""
MIN_SCANS = 3
"""Scans before, and scans after, that have to see a cell occupied."""
CLEAR_S, CLEAR_M = 1.0, 1.0
"""Seconds, and metres beyond half of its length, that an object takes at least to reach and to leave a place: what
occupies it earlier and later is not the object itself."""
MIN_SPEED = 0.3
"""Metres per second below which the time to leave a place is not known."""
STEP = 0.2
"""Metres between the places along a way that are looked at."""
LINES = (-0.25, 0.0, 0.25)
"""Fractions of the width of a box, beside the way of its centre, where lines of such places lie."""
_SPAN = 1 << 20
"""Cells along one axis of the grid."""


class StandingMap:
    """The cells that returns which do not move occupy in each scan; `moving` tells which of its returns do, and
    `ground` the height of the ground at a place, NaN where it is unknown."""

    def __init__(
        self,
        scans: Sequence[RecordedScan],
        moving: Sequence[Bool[np.ndarray, " _"]],
        ground: Callable[[Float[np.ndarray, "2"]], float],
    ):
        self._seconds = np.array([scan.seconds for scan in scans])
        heights: dict[int, float] = {}
        found = []
        for number, (scan, own) in enumerate(zip(scans, moving, strict=True)):
            cells = _obstacles(scan.points()[~own], ground, heights)
            found.append(cells * len(scans) + number)
        self._keys = np.sort(np.concatenate(found))

    def blocks(
        self, places: Float[np.ndarray, "n 2"], arrives: Float[np.ndarray, " n"], leaves: Float[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether each place was occupied before an object `arrives` there, and again after it `leaves` (seconds)."""
        count, base = len(self._seconds), _cells(places, CELL) * len(self._seconds)
        start, end = np.searchsorted(self._keys, base), np.searchsorted(self._keys, base + count)
        until = np.searchsorted(self._keys, base + np.searchsorted(self._seconds, arrives))
        since = np.searchsorted(self._keys, base + np.searchsorted(self._seconds, leaves, side="right"))
        return (until - start >= MIN_SCANS) & (end - since >= MIN_SCANS)

    def blocked_link(self, before: Cluster, after: Cluster) -> bool:
        """Whether the straight way from one cluster to another one leads through a place that stays occupied."""
        way = after.place - before.place
        length, span = float(np.linalg.norm(way)), after.seconds - before.seconds
        clear = max(CLEAR_S, CLEAR_M / max(length / max(span, 1e-6), MIN_SPEED))
        shares = np.linspace(0.0, 1.0, max(2, int(length / STEP) + 1))
        seconds = before.seconds + shares * span
        return bool(self.blocks(before.place + shares[:, None] * way, seconds - clear, seconds + clear).any())

    def blocked_share(self, item: Discovered) -> float:
        """The fraction of the way of an object on which its box, less its sides, meets places that stay occupied."""
        fine = np.linspace(item.seconds[0], item.seconds[-1], 10 * len(item.seconds))
        steps = np.linalg.norm(np.diff(item.path.places(fine), axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(steps)])
        seconds = np.interp(np.arange(0.0, travelled[-1] + STEP, STEP), travelled, fine)
        speeds = np.linalg.norm(item.path.velocities(seconds), axis=1)
        clear = np.maximum(CLEAR_S, (0.5 * item.size[0] + CLEAR_M) / np.maximum(speeds, MIN_SPEED))
        poses = item.poses(seconds)
        aside = item.size[1] * poses[:, :2, 1]
        lines = [self.blocks(poses[:, :2, 3] + k * aside, seconds - clear, seconds + clear) for k in LINES]
        return float(np.any(lines, axis=0).mean())


def _obstacles(
    points: Float[np.ndarray, "n 3"], ground: Callable[[Float[np.ndarray, "2"]], float], heights: dict[int, float]
) -> Int[np.ndarray, " k"]:
    """The cells of returns between LOW and HIGH above the ground. `heights` are those of the ground that are known by
    now, by the number of the square; new ones are added."""
    squares, inverse = np.unique(_cells(points[:, :2], GROUND_CELL), return_inverse=True)
    for square in squares.tolist():
        if square not in heights:
            corner = np.array([square // _SPAN, square % _SPAN]) - _SPAN // 2
            heights[square] = ground((corner + 0.5) * GROUND_CELL)
    above = points[:, 2] - np.array([heights[square] for square in squares.tolist()])[inverse]
    return np.unique(_cells(points[(above > LOW) & (above < HIGH), :2], CELL))


def _cells(places: Float[np.ndarray, "n 2"], side: float) -> Int[np.ndarray, " n"]:
    """The number of the cell of each place, in a grid of cells with `side` metres."""
    columns = np.floor(places / side).astype(np.int64) + _SPAN // 2
    return columns[:, 0] * _SPAN + columns[:, 1]
