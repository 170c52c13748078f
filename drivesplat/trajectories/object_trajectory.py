"""The recorded trajectory of an object, by time and by distance.

Frames as in `drivesplat.scene.scene`: object x forward, y left, z up, at the box centre; world in metres.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from drivesplat.scene.rigid import inverse
from drivesplat.trajectories.extrapolation import EndState, end_state, extrapolate
from drivesplat.trajectories.motion import Motion

SAMPLE_INTERVAL = 0.01
"""Seconds between the samples at which distance is measured."""
KNOT_SPACING = 1.0
"""Metres between the knots of the path by distance, so that annotation noise adds no distance. The spline between them
deviates from a turn of 5 m radius by 0.02 mm."""
MIN_PATH_LENGTH = 3.0
"""Metres; the path of an object that moves less is a straight line through one position."""
SETTLING_TIME = 0.5
"""Seconds after the end of a track in which turning and acceleration fade out."""
SETTLING_DISTANCE = 5.0
"""Metres after the end of the path by distance over which its curvature fades out."""


@dataclass(frozen=True)
class ObjectTrajectory:
    """The trajectory of a motion.

    Distance is horizontal, in metres from the first annotation; it never decreases and is constant while the object
    stands. Past its ends the trajectory is extrapolated straight on (`extrapolation`); a gap of the track is bridged
    smoothly.
    """

    motion: Motion

    def poses_at_time(self, times: np.ndarray) -> np.ndarray:
        """The recorded poses (n, 4, 4) at recorded `times` (n,) in seconds; exact while the motion is defined."""
        motion, reach, ends = self.motion, self.motion.reach, self.motion.times[[0, -1]]
        beyond = np.abs(times - times.clip(*ends)) > reach
        poses = motion.poses(times)
        if beyond.any():
            past = (times - times.clip(*ends))[beyond]
            # turning fades out beyond the reach of the motion and ends at the heading of the end
            straightening = CubicHermiteSpline([reach, reach + SETTLING_TIME], [reach, 0.0], [1.0, 0.0])
            turned = np.sign(past) * straightening(np.minimum(np.abs(past), reach + SETTLING_TIME))
            poses[beyond, :3, :3] = motion.poses(times[beyond] - past + turned)[:, :3, :3]
            positions = np.empty((len(past), 3))
            for end, chosen in self._past_ends(past):
                side = float(np.sign(past[chosen][0]))
                reached = side * reach
                known = motion.poses(ends[1 if side > 0 else 0] + np.array([0.0, reached]))[:, :3, 3]
                velocity, steady = (known[1] - known[0]) / reached, end.speed * end.direction
                positions[chosen] = known[1] + extrapolate(past[chosen] - reached, velocity, steady, SETTLING_TIME)
            poses[beyond, :3, 3] = positions
        for (low, high), (positions, rotations) in self._bridges.items():
            within = (times > low) & (times < high)
            poses[within, :3, 3] = positions(times[within])
            poses[within, :3, :3] = rotations(times[within]).as_matrix()
        return poses

    def distance(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres at recorded `times` (n,) in seconds."""
        spline, _, _ = self._by_distance
        within = times.clip(spline.x[0], spline.x[-1])
        distances, past = spline(within), times - within
        for end, chosen in self._past_ends(past):
            slope = spline(within[chosen][:1], 1)
            steady, over = np.array([end.speed]), self.motion.reach + SETTLING_TIME
            distances[chosen] += extrapolate(past[chosen], slope, steady, over)[:, 0]
        return distances

    @cached_property
    def recorded_range(self) -> tuple[float, float]:
        """The first and the last recorded distance in metres."""
        low, high = self.distance(np.array(self.motion.span))
        return float(low), float(high)

    def poses_at_distance(self, distances: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) at `distances` (n,) in metres, without the motion of a standing object."""
        _, known, poses = self._by_distance
        within = distances.clip(known[0], known[-1])
        past, result = distances - within, np.tile(poses[0], (len(distances), 1, 1))
        if len(known) > 1:
            positions, rotations = self._knot_splines
            result[:, :3, 3], result[:, :3, :3] = positions(within), rotations(within).as_matrix()
        for end, chosen in self._past_ends(past):
            tangent = positions(within[chosen][0], 1) if len(known) > 1 else end.direction
            tangent = tangent / np.linalg.norm(tangent[:2])
            arrived_backwards = not end.speed and tangent[:2] @ end.direction[:2] < 0.0  # a standing object may have
            continued = end.direction * [-1.0, -1.0, 1.0] if arrived_backwards else end.direction
            result[chosen, :3, 3] += extrapolate(past[chosen], tangent, continued, SETTLING_DISTANCE)
        return result

    def deviation(self, times: np.ndarray) -> np.ndarray:
        """The transforms (n, 4, 4) from `poses_at_distance(distance(times))` to `poses_at_time(times)`, in the frames
        of the former: centimetres, most of them while the object stands."""
        return inverse(self.poses_at_distance(self.distance(times))) @ self.poses_at_time(times)

    def _past_ends(self, past: np.ndarray) -> list[tuple[EndState, np.ndarray]]:
        """The state at the first and at the last end, each with a mask (n,) of the `past` (n,) beyond it, if any."""
        sides = ((self._ends[0], past < 0.0), (self._ends[1], past > 0.0))
        return [(end, chosen) for end, chosen in sides if chosen.any()]

    @cached_property
    def _ends(self) -> tuple[EndState, EndState]:
        return end_state(self.motion, last=False), end_state(self.motion, last=True)

    @cached_property
    def _bridges(self) -> dict[tuple[float, float], tuple[CubicHermiteSpline, RotationSpline]]:
        """Per gap, from the last second before it to the first after it, splines of position and rotation with
        continuous speed; the turn rates at its ends are approximate."""
        motion, bridges = self.motion, {}
        for (_, end), (begin, _) in zip(motion.runs[:-1], motion.runs[1:], strict=True):
            low, high = motion.times[end] + motion.reach, motion.times[begin] - motion.reach
            if low >= high:
                continue
            times = np.array([low - SAMPLE_INTERVAL, low, high, high + SAMPLE_INTERVAL])
            poses = motion.poses(times)
            speeds = np.diff(poses[:, :3, 3], axis=0)[[0, 2]] / SAMPLE_INTERVAL
            positions = CubicHermiteSpline([low, high], poses[1:3, :3, 3], speeds)
            rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))
            bridges[float(low), float(high)] = positions, rotations
        return bridges

    @cached_property
    def _by_distance(self) -> tuple[PchipInterpolator, np.ndarray, np.ndarray]:
        """The distance by recorded seconds; distances (k,) and poses (k, 4, 4) of the knots of the path by distance."""
        first, last = self.motion.times[[0, -1]]
        times = np.linspace(first, last, int((last - first) / SAMPLE_INTERVAL) + 1)
        poses = self.poses_at_time(times)
        distances, knots = _measured(poses[:, :2, 3])
        if distances[-1] < MIN_PATH_LENGTH:
            heading = poses[0, :2, 0] / np.linalg.norm(poses[0, :2, 0])
            distances, knots = np.maximum.accumulate((poses[:, :2, 3] - poses[0, :2, 3]) @ heading), np.array([0])
        if len(times) == 1:
            spline = PchipInterpolator([times[0], times[0] + 1.0], [0.0, 0.0])
        else:
            spline = PchipInterpolator(times, distances)
        return spline, distances[knots], poses[knots]

    @cached_property
    def _knot_splines(self) -> tuple[CubicSpline, RotationSpline]:
        _, distances, poses = self._by_distance
        rotations = Rotation.from_matrix(poses[:, :3, :3])
        return CubicSpline(distances, poses[:, :3, 3], bc_type="natural"), RotationSpline(distances, rotations)


def _measured(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distances (m,) of horizontal `positions` (m, 2) along their path, and the indices (k,) of knots about
    KNOT_SPACING apart, the last position among them.

    Between two knots distance is measured from the first, so that noise around one position adds none.
    """
    distances, knots = np.zeros(len(positions)), [0]
    for i in range(1, len(positions)):
        reached = distances[knots[-1]] + float(np.linalg.norm(positions[i] - positions[knots[-1]]))
        distances[i] = max(distances[i - 1], reached)
        if reached >= distances[knots[-1]] + KNOT_SPACING:
            knots.append(i)
    if len(knots) > 1 and distances[-1] - distances[knots[-1]] < KNOT_SPACING / 2:
        knots.pop()
    return distances, np.array([*knots, len(positions) - 1])
