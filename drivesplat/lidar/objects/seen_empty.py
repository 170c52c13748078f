"""Returns in space that other scans prove empty: they lie on moving objects.

A scan some seconds earlier or later looks along its own rays past the place of a return. If all its rays around that
place went on beyond it, the place was empty then; if one ended there, it was occupied. A place that is behind what the
other scan met, or outside its field of view, is unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Int8
from scipy.spatial.transform import Rotation

from drivesplat.io.prefetch import prefetch
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scan_record import RecordedScan

BASELINES_S = (0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Seconds before and after a scan from which others are asked; the nearest scan to each counts."""
MIN_BASELINE_S = 0.2
"""Seconds within which slow objects have hardly moved."""
MIN_EMPTY = 2
"""Number of scans that have to see a place empty; more of them than see it occupied."""
BEYOND, BEYOND_SHARE = 0.4, 0.02
"""Metres, and fraction of the range, by which rays have to go on beyond a place that is empty."""
AT, AT_SHARE = 0.3, 0.01
"""Metres, and fraction of the range, within which a ray ends at a place."""
MIN_KNOWN = 4
"""Of the six rays around a place, those that have to return if it is empty."""


@dataclass(frozen=True)
class RangeGrid:
    """The ranges of a scan's measured returns on a grid of beams, from low to high, and even steps of azimuth from -π;
    NaN where there is none."""

    scan: RecordedScan

    @cached_property
    def elevations(self) -> Float[np.ndarray, " b"]:
        """The elevation of each beam in radians, ascending."""
        return np.sort(self.scan.scan.rays.beam_elevations)

    @cached_property
    def ranges(self) -> Float[np.ndarray, "b a"]:
        """Ranges in metres."""
        own = self.scan
        known = np.where(own.scan.returned & own.measured, own.scan.ranges, np.nan)
        grid = np.full(known.shape, np.nan, dtype=np.float32)
        beams = np.broadcast_to(np.arange(len(known))[:, None], known.shape)
        grid[beams, self._columns(own.scan.rays.azimuths)] = known
        return grid[np.argsort(own.scan.rays.beam_elevations, kind="stable")]

    @cached_property
    def offsets_s(self) -> Float[np.ndarray, " a"]:
        """The mean time of each column in seconds from the scan's timestamp."""
        rays = self.scan.scan.rays
        columns, count = self._columns(rays.azimuths).ravel(), rays.shape[1]
        found = np.bincount(columns, minlength=count)
        mean = np.bincount(columns, rays.offsets_s.ravel(), count) / np.maximum(found, 1)
        filled = np.flatnonzero(found)
        return np.interp(np.arange(count), filled, mean[filled])

    @cached_property
    def _turns(self) -> Float[np.ndarray, "a 3 3"]:
        """The rotation from the sensor at its timestamp to the sensor at the time of each column."""
        return Rotation.from_rotvec(-self.offsets_s[:, None] * self.scan.angular).as_matrix().astype(np.float32)

    @cached_property
    def _ways(self) -> Float[np.ndarray, "a 3"]:
        """The way in metres of the sensor from its timestamp to the time of each column."""
        return (self.offsets_s[:, None] * self.scan.linear).astype(np.float32)

    def _columns(self, azimuths: np.ndarray) -> np.ndarray:
        count = self.scan.scan.rays.shape[1]
        return np.floor((azimuths + np.pi) * (count / (2.0 * np.pi))).astype(np.int64) % count

    @cached_property
    def _around(self) -> tuple[Float[np.ndarray, "b a"], Int8[np.ndarray, "b a"]]:
        """The least range of the six rays around places between each beam and the one below it, in each column, and how
        many of them return."""
        below = np.stack([self.ranges[:-1], self.ranges[1:]])
        six = np.stack([np.roll(below, step, axis=2) for step in (-1, 0, 1)]).reshape(6, *below.shape[1:])
        least, known = np.full(self.ranges.shape, np.inf, np.float32), np.zeros(self.ranges.shape, np.int8)
        least[1:], known[1:] = np.fmin.reduce(six, axis=0), np.isfinite(six).sum(axis=0)
        return least, known

    def empty(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether this scan saw each place in the world (metres) empty."""
        above, columns, ranges, in_view = self._looks(points)
        least, known = (values[above, columns] for values in self._around)
        return in_view & (known >= MIN_KNOWN) & (least > ranges * (1.0 + BEYOND_SHARE) + BEYOND)

    def occupied(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether this scan saw each place in the world (metres) occupied."""
        above, columns, ranges, in_view = self._looks(points)
        near, count = np.zeros(len(points), dtype=bool), self.ranges.shape[1]
        for beam in (-1, 0):
            for step in (-1, 0, 1):
                around = self.ranges[above + beam, (columns + step) % count]
                near |= np.abs(around - ranges) < AT + AT_SHARE * ranges  # False for NaN
        return in_view & near

    def _looks(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """The beam above each place in the world (metres), the column that looks at it, its range, and whether it lies
        between the lowest and the highest beam."""
        places = apply(inverse(self.scan.sensor_to_world), points).astype(np.float32)
        # In the sensor's frame at the time when it looks at them; the sensor moves by millimetres in the time by which
        # the azimuths at the timestamp are off.
        columns = self._columns(np.arctan2(places[:, 1], places[:, 0]))
        moved = places - self._ways[columns]
        places = np.einsum("nij,nj->ni", self._turns[columns], moved)
        columns = self._columns(np.arctan2(places[:, 1], places[:, 0]))
        ranges = np.maximum(np.linalg.norm(places, axis=1), 1e-6)
        elevations = np.arcsin(np.clip(places[:, 2] / ranges, -1.0, 1.0))
        above = np.searchsorted(self.elevations, elevations)
        in_view = (above > 0) & (above < len(self.elevations)) & np.isfinite(ranges)
        return np.clip(above, 1, len(self.elevations) - 1), columns, ranges, in_view


def seen_empty(scans: Sequence[RecordedScan], threads: int = 1) -> list[Bool[np.ndarray, " n"]]:
    """For each of the scans of one LiDAR, in order of time, which of its measured returns (`RecordedScan.points`) lie
    in space that other scans prove empty."""
    images = [RangeGrid(scan) for scan in scans]
    seconds = np.array([scan.seconds for scan in scans])

    def of_scan(number: int) -> Bool[np.ndarray, " n"]:
        return _seen_empty_by(scans[number].points(), [images[other] for other in asked(seconds, number)])

    return list(prefetch(of_scan, range(len(scans)), threads))


def _seen_empty_by(points: Float[np.ndarray, "n 3"], images: Sequence[RangeGrid]) -> Bool[np.ndarray, " n"]:
    """Whether at least MIN_EMPTY scans see each place in the world (metres) empty, and more than see it occupied. Most
    places are never seen empty: those that the scans left cannot prove empty any more are not looked at again."""
    rows, empty = np.arange(len(points)), np.zeros(len(points), dtype=np.int64)
    for left, image in zip(range(len(images) - 1, -1, -1), images, strict=True):
        empty = empty + image.empty(points[rows])
        possible = empty + left >= MIN_EMPTY
        rows, empty = rows[possible], empty[possible]
    occupied = sum((image.occupied(points[rows]).astype(np.int64) for image in images), np.zeros(len(rows), np.int64))
    found = np.zeros(len(points), dtype=bool)
    found[rows] = (empty >= MIN_EMPTY) & (empty > occupied)
    return found


def asked(seconds: Float[np.ndarray, " s"], number: int) -> list[int]:
    """The scans that are asked about the returns of scan `number`, of those at increasing `seconds`."""
    interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    found = set()
    for baseline in (sign * length for length in BASELINES_S for sign in (-1.0, 1.0)):
        other = int(np.argmin(np.abs(seconds - (seconds[number] + baseline))))
        missed = abs(seconds[other] - seconds[number] - baseline)
        if missed <= 0.6 * interval and abs(seconds[other] - seconds[number]) >= MIN_BASELINE_S:
            found.add(other)
    return sorted(found)
