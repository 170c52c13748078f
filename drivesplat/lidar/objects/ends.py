"""The ends of the time in which objects are seen.

Whether a place is empty is seen a while before or after: in the first and the last moments of a drive, and where other
objects hide what lies behind, nothing tells that a return moves. An object that was found goes straight on there, as
long as returns lie in its box.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.scene.scan_record import RecordedScan

MAX_BEYOND_S = 0.6
"""Seconds for which an object is followed beyond the time in which it was seen to move."""
KEPT, LEAST = 0.5, 3
"""Fraction of the returns that it had, and number of returns, that have to lie in its box."""
TYPICAL_SCANS = 5
"""Scans next to an end from which the former follows, by their median."""
KERB, MARGIN = 0.3, 0.1
"""Metres above the ground, and around the sides of a box, from which and to which returns count."""


class Ends:
    """The scans of one LiDAR in order of time, in which objects are followed."""

    def __init__(self, scans: Sequence[RecordedScan]):
        self._scans = scans
        self._seconds = np.array([scan.seconds for scan in scans])
        self._returns: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def followed(self, item: Discovered) -> Discovered:
        """The object, seen as long as returns lie in its box before and after the time in which it moved."""
        seen = np.flatnonzero((self._seconds >= item.seconds[0]) & (self._seconds <= item.seconds[-1])).tolist()
        if not seen:
            return item
        first, last = self._end(item, seen[::-1], -1), self._end(item, seen, 1)
        columns = (item.seconds, item.headings, item.grounds)
        seconds, headings, grounds = (np.concatenate([column[:1], column, column[-1:]]) for column in columns)
        seconds[0], seconds[-1] = min(first, item.seconds[0]), max(last, item.seconds[-1])
        kept = np.concatenate(
            [[seconds[0] < seconds[1]], np.ones(len(item.seconds), dtype=bool), [seconds[-1] > seconds[-2]]]
        )
        return replace(item, seconds=seconds[kept], headings=headings[kept], grounds=grounds[kept])

    def _end(self, item: Discovered, seen: Sequence[int], step: int) -> float:
        """The time of the last scan in which it is, from those in which it was `seen` to move onwards by `step`."""
        wanted = KEPT * float(np.median([self._count(item, number) for number in seen[-TYPICAL_SCANS:]]))
        number = seen[-1] + step
        while (
            0 <= number < len(self._scans)
            and abs(self._seconds[number] - self._seconds[seen[-1]]) <= MAX_BEYOND_S
            and self._count(item, number) >= max(wanted, LEAST)
        ):
            number += step
        return float(self._seconds[number - step])

    def _count(self, item: Discovered, number: int) -> int:
        """The number of returns of a scan in the box of an object, each at its own time."""
        points, times = self._of_scan(number)
        centre = item.path.places(self._seconds[number : number + 1])[0]
        near = np.linalg.norm(points[:, :2] - centre, axis=1) < np.linalg.norm(item.size[:2]) + 1.0
        poses = item.poses(times[near])
        local = np.einsum("nji,nj->ni", poses[:, :3, :3], points[near] - poses[:, :3, 3])
        inside = (np.abs(local[:, :2]) < 0.5 * item.size[:2] + MARGIN).all(axis=1)
        inside &= (local[:, 2] > KERB - 0.5 * item.size[2]) & (local[:, 2] < 0.5 * item.size[2] + MARGIN)
        return int(inside.sum())

    def _of_scan(self, number: int) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """The returns of a scan in the world, and their times in seconds of the scene."""
        if number not in self._returns:
            scan = self._scans[number]
            offsets = scan.scan.rays.offsets_s[scan.scan.returned & scan.measured].astype(np.float64)
            self._returns[number] = scan.points(), scan.seconds + offsets
        return self._returns[number]
