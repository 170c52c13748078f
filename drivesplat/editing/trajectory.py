"""The course of a recorded object: by the clock, as it was driven, and by the metre, however fast it is driven.

Frames as in `drivesplat.scene.scene`: object x forward, y left, z up, at the box centre; world metres.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from drivesplat.editing.extrapolation import End, end_of, onward
from drivesplat.scene.motion import Motion
from drivesplat.scene.rigid import inverse

SAMPLE = 0.01
"""Seconds between the recorded places that the path by the metre is measured at."""
SPACING = 1.0
"""Metres between the places that it leads through: annotations tremble, and who stands shall not get from one to the
next. The path between them bends as it was driven: by 0.02 mm off in a turn of 5 m radius."""
LEAST_WAY = 3.0
"""A path shorter than this (metres) is that of something that stands: it leads straight on from one place."""
SETTLES = 0.5
"""Seconds in which what it does at the end of a track becomes steady: a bend straightens, speed no longer changes."""
SETTLES_OVER = 5.0
"""Metres over which the path by the metre does."""


@dataclass(frozen=True)
class Course:
    """The path that a motion leads along.

    Metres count horizontally along the path from the first annotation; they never decrease, and do not grow while the
    object stands. Past its ends the path leads straight on, as `drivesplat.editing.extrapolation` says, and over a gap
    of the track smoothly.
    """

    motion: Motion

    def recorded(self, clock: np.ndarray) -> np.ndarray:
        """Where the object was (n, 4, 4) at the recorded seconds `clock` (n,): where the motion knows it, exactly."""
        first, last = self.motion.times[[0, -1]]
        past = clock - clock.clip(first, last)
        poses = self.motion.poses(clock)
        straight = np.abs(past) > self.motion.reach
        if straight.any():
            bent = clock[straight] - past[straight] + self._bends_on(past[straight])
            poses[straight, :3, :3] = self.motion.poses(bent)[:, :3, :3]
            poses[straight, :3, 3] = self._goes_on(past[straight])
        for (low, high), (positions, rotations) in self._bridges.items():
            within = (clock > low) & (clock < high)
            poses[within, :3, 3] = positions(clock[within])
            poses[within, :3, :3] = rotations(clock[within]).as_matrix()
        return poses

    def metres(self, clock: np.ndarray) -> np.ndarray:
        """How far along the path (n,) it was at the recorded seconds `clock` (n,)."""
        spline = self._metres
        within = clock.clip(spline.x[0], spline.x[-1])
        metres, past = spline(within), clock - within
        for end, chosen in self._beyond(past):
            slope = spline(within[chosen][:1], 1)
            steady, over = np.array([end.speed]), self.motion.reach + SETTLES
            metres[chosen] += onward(past[chosen], slope, steady, over)[:, 0]
        return metres

    @cached_property
    def stretch(self) -> tuple[float, float]:
        """From where to where (metres) it was recorded."""
        low, high = self.metres(np.array(self.motion.span))
        return float(low), float(high)

    def places(self, metres: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) that lie `metres` (n,) along the path, without what happened while the object stood."""
        known, poses = self._places
        within = metres.clip(known[0], known[-1])
        past, result = metres - within, np.tile(poses[0], (len(metres), 1, 1))
        if len(known) > 1:
            positions, rotations = self._through
            result[:, :3, 3], result[:, :3, :3] = positions(within), rotations(within).as_matrix()
        for end, chosen in self._beyond(past):
            momentary = positions(within[chosen][0], 1) if len(known) > 1 else end.direction
            momentary = momentary / np.linalg.norm(momentary[:2])
            result[chosen, :3, 3] += onward(past[chosen], momentary, end.after(momentary), SETTLES_OVER)
        return result

    def deviation(self, clock: np.ndarray) -> np.ndarray:
        """The transforms (n, 4, 4) that take `places(metres(clock))` to `recorded(clock)`, in the frames of the former:
        centimetres, most of them while it stands."""
        return inverse(self.places(self.metres(clock))) @ self.recorded(clock)

    def _beyond(self, past: np.ndarray) -> list[tuple[End, np.ndarray]]:
        """How it goes on before its beginning and past its end, and which (n,) of `past` (n,) are there."""
        sides = ((self._ends[0], past < 0.0), (self._ends[1], past > 0.0))
        return [(end, chosen) for end, chosen in sides if chosen.any()]

    def _goes_on(self, past: np.ndarray) -> np.ndarray:
        """Positions (n, 3) at seconds `past` (n,) an end, beyond the reach of the motion there."""
        motion, positions = self.motion, np.empty((len(past), 3))
        for end, chosen in self._beyond(past):
            side = float(np.sign(past[chosen][0]))
            reached = side * motion.reach
            at = motion.times[-1 if side > 0 else 0] + np.array([0.0, reached])
            known = motion.poses(at)[:, :3, 3]
            momentary = (known[1] - known[0]) / reached
            positions[chosen] = known[1] + onward(past[chosen] - reached, momentary, end.velocity, SETTLES)
        return positions

    @cached_property
    def _ends(self) -> tuple[End, End]:
        return end_of(self.motion, last=False), end_of(self.motion, last=True)

    def _bends_on(self, past: np.ndarray) -> np.ndarray:
        """For seconds (n,) past an end, up to which of them a bend goes on: within reach as the motion has it, then
        less and less, so that who drives straight on points there."""
        reach = self.motion.reach
        straightening = CubicHermiteSpline([reach, reach + SETTLES], [reach, 0.0], [1.0, 0.0])
        return np.sign(past) * straightening(np.minimum(np.abs(past), reach + SETTLES))

    @cached_property
    def _bridges(self) -> dict[tuple[float, float], tuple[CubicHermiteSpline, RotationSpline]]:
        """Per gap, from the last second before it to the first after it, position and rotation with no jump in speed;
        the turn rates at its ends are approximate."""
        motion, bridges = self.motion, {}
        for (_, end), (begin, _) in zip(motion.runs[:-1], motion.runs[1:], strict=True):
            low, high = motion.times[end] + motion.reach, motion.times[begin] - motion.reach
            if low >= high:
                continue
            at = np.array([low - SAMPLE, low, high, high + SAMPLE])
            poses = motion.poses(at)
            speeds = np.diff(poses[:, :3, 3], axis=0)[[0, 2]] / SAMPLE
            positions = CubicHermiteSpline([low, high], poses[1:3, :3, 3], speeds)
            bridges[float(low), float(high)] = positions, RotationSpline(at, Rotation.from_matrix(poses[:, :3, :3]))
        return bridges

    @cached_property
    def _samples(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Recorded seconds (m,), the poses (m, 4, 4) and metres (m,) there, and which of them are SPACING apart."""
        first, last = self.motion.times[[0, -1]]
        at = np.linspace(first, last, int((last - first) / SAMPLE) + 1)
        poses = self.recorded(at)
        metres, kept = _measured(poses[:, :2, 3])
        if metres[-1] < LEAST_WAY:
            heading = poses[0, :2, 0] / np.linalg.norm(poses[0, :2, 0])
            metres, kept = np.maximum.accumulate((poses[:, :2, 3] - poses[0, :2, 3]) @ heading), np.array([0])
        return at, poses, metres, kept

    @cached_property
    def _metres(self) -> PchipInterpolator:
        at, _, metres, _ = self._samples
        return PchipInterpolator(at, metres) if len(at) > 1 else PchipInterpolator([at[0], at[0] + 1.0], [0.0, 0.0])

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """The metres (k,) and the poses (k, 4, 4) that the path leads through."""
        _, poses, metres, kept = self._samples
        return metres[kept], poses[kept]

    @cached_property
    def _through(self) -> tuple[CubicSpline, RotationSpline]:
        metres, poses = self._places
        rotations = Rotation.from_matrix(poses[:, :3, :3])
        return CubicSpline(metres, poses[:, :3, 3], bc_type="natural"), RotationSpline(metres, rotations)


def _measured(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along a path horizontal `places` (m, 2) are, (m,), and which of them (k,), the last among them, are about
    SPACING apart.

    Between two of those it is the distance from the first: what trembles on the spot makes no way.
    """
    metres, kept = np.zeros(len(places)), [0]
    for i in range(1, len(places)):
        reached = metres[kept[-1]] + float(np.linalg.norm(places[i] - places[kept[-1]]))
        metres[i] = max(metres[i - 1], reached)
        if reached >= metres[kept[-1]] + SPACING:
            kept.append(i)
    if len(kept) > 1 and metres[-1] - metres[kept[-1]] < SPACING / 2:
        kept.pop()
    return metres, np.array([*kept, len(places) - 1])
