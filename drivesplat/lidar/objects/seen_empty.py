"""Returns in space that other scans prove empty: they lie on moving objects.

A scan some seconds earlier or later looks along its own rays past the place of a return. If all its rays around that
place went on beyond it, the place was empty then; if one ended there, it was occupied. A place that is behind what the
other scan met, or outside its field of view, is unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

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
STEPS = 2
"""Iterations to find the time at which a spinning sensor looks at a place."""


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
        return Rotation.from_rotvec(-self.offsets_s[:, None] * self.scan.angular).as_matrix()

    def _columns(self, azimuths: np.ndarray) -> np.ndarray:
        count = self.scan.scan.rays.shape[1]
        return np.floor((azimuths + np.pi) * (count / (2.0 * np.pi))).astype(np.int64) % count

    def seen(self, points: Float[np.ndarray, "n 3"]) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Whether this scan saw each place in the world (metres) empty, and whether it saw it occupied."""
        at_timestamp = places = apply(inverse(self.scan.sensor_to_world), points)
        for _ in range(STEPS):  # in the sensor's frame at the time when it looks at them
            columns = self._columns(np.arctan2(places[:, 1], places[:, 0]))
            moved = at_timestamp - self.offsets_s[columns][:, None] * self.scan.linear
            places = np.einsum("nij,nj->ni", self._turns[columns], moved)
        columns = self._columns(np.arctan2(places[:, 1], places[:, 0]))
        ranges = np.maximum(np.linalg.norm(places, axis=1), 1e-6)
        elevations = np.arcsin(np.clip(places[:, 2] / ranges, -1.0, 1.0))
        above = np.searchsorted(self.elevations, elevations)
        in_view = (above > 0) & (above < len(self.elevations))
        above = np.clip(above, 1, len(self.elevations) - 1)
        count = self.ranges.shape[1]
        limit, tolerance = ranges * (1.0 + BEYOND_SHARE) + BEYOND, AT + AT_SHARE * ranges
        known, near = np.zeros(len(points), dtype=np.int8), np.zeros(len(points), dtype=bool)
        beyond = in_view & np.isfinite(ranges)
        for beam in (-1, 0):
            for step in (-1, 0, 1):
                around = self.ranges[above + beam, (columns + step) % count]
                known += np.isfinite(around)
                beyond &= ~(around <= limit)  # True for NaN
                near |= np.abs(around - ranges) < tolerance  # False for NaN
        return beyond & (known >= MIN_KNOWN), in_view & near


def seen_empty(scans: Sequence[RecordedScan]) -> list[Bool[np.ndarray, " n"]]:
    """For each of the scans of one LiDAR, in order of time, which of its measured returns (`RecordedScan.points`) lie
    in space that other scans prove empty."""
    images = [RangeGrid(scan) for scan in scans]
    seconds = np.array([scan.seconds for scan in scans])
    found = []
    for number, scan in enumerate(scans):
        points = scan.points()
        empty, occupied = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
        for other in asked(seconds, number):
            was_empty, was_occupied = images[other].seen(points)
            empty += was_empty
            occupied += was_occupied
        found.append((empty >= MIN_EMPTY) & (empty > occupied))
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
