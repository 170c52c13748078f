"""The path of an actor in an edited drive: its recorded trajectory by time and by distance, its position along it over
time, and its offsets from it.

`times` (n,) are seconds of the film. `edited_actors` creates paths, `drivesplat.trajectories.steps` changes them.
Frames as in `drivesplat.scene.scene`: object x forward, y left, z up, at the box centre; world in metres.

Past its ends a track is extrapolated, robust to annotation noise. The speed at the very end of an interpolated motion
is as inaccurate as two boxes: centimetres of noise would become metres ten seconds later. Speed and direction are
therefore fitted to several annotations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from drivesplat.scene.rigid import inverse
from drivesplat.trajectories.lateral_offset import offset_poses, rotate_yaw
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.transition import Transition

FITTED_STEPS = 4
"""Number of steps between annotations to which speed and direction at an end are fitted."""
STANDSTILL_SPEED = 0.5
"""Speed (m/s) below which a track counts as standing at its end; annotation noise of 5 cm stays below it."""
MIN_TURNING_SPEED = 1.0
"""Speed (m/s) from which a change of direction is fitted; below, it is indistinguishable from annotation noise."""
SLOPE_DISTANCE = 20.0
"""Distance (metres) over which the slope at an end is measured; a shorter track is extrapolated at constant height."""
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
class EndState:
    """The motion at an end of a track, in the direction of time: `direction` (3,) in the world, of horizontal length 1,
    and the horizontal `speed` along it in m/s, 0 for a standing object."""

    direction: np.ndarray
    speed: float


@dataclass(frozen=True)
class ObjectTrajectory:
    """The trajectory of a motion.

    Distance is horizontal, in metres from the first annotation; it never decreases and is constant while the object
    stands. Past its ends the trajectory is extrapolated straight on; a gap of the track is bridged
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
        if not np.ptp(self.motion.object_to_world[:, :2, 3], axis=0).any():  # it stands, perhaps for an hour
            times = self.motion.times
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


@dataclass(frozen=True)
class PathPosition:
    """A position along a trajectory: that at the recorded seconds `clock` (n,), plus `advance` (n,) metres.

    `deviation_weight` (n,) in [0, 1] weighs the deviation of the recording from the path by distance; 0 at a speed
    independent of the recorded one.
    """

    clock: np.ndarray
    advance: np.ndarray
    deviation_weight: np.ndarray


@dataclass(frozen=True)
class PathOffsets:
    """Offsets from a path, each (n,): `longitudinal` metres forward along it, `lateral` metres to its left,
    `lateral_speed` in m/s, `yaw` in radians to the left."""

    longitudinal: np.ndarray
    lateral: np.ndarray
    lateral_speed: np.ndarray
    yaw: np.ndarray


@dataclass(frozen=True)
class ActorPath:
    """A path along `trajectory`, whose box centres were recorded half of `height` (metres) above the ground.

    `position`, `offsets` and `recorded` (presence in the recording, (n,) bool) are functions of film seconds (n,).
    `begin` and `end` are the first and last second as recorded, `paced_from` the second from which the pace is edited.
    `direction` is 1 as recorded, -1 backwards; `facing` is 1 as recorded, -1 turned round.
    """

    trajectory: ObjectTrajectory
    height: float
    position: Callable[[np.ndarray], PathPosition]
    offsets: Callable[[np.ndarray], PathOffsets]
    recorded: Callable[[np.ndarray], np.ndarray]
    begin: float
    end: float
    paced_from: float = np.inf
    direction: int = 1
    facing: int = 1

    def distance(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres along the trajectory, without offsets."""
        position = self.position(times)
        return self.trajectory.distance(position.clock) + position.advance

    def walked(self, times: np.ndarray) -> np.ndarray:
        """The distance (n,) in metres by which the limbs of the actor have advanced: backwards where it moves against
        the direction that it faces."""
        return self.facing * self.distance(times)

    def present(self, times: np.ndarray) -> np.ndarray:
        """Whether the actor is present (n,): while it was recorded and, once its pace is edited, also while its
        distance without offsets is within the recorded range."""
        present, paced = self.recorded(times), times >= self.paced_from
        if paced.any():
            low, high = self.trajectory.recorded_range
            distances = self.distance(times[paced])
            present[paced] |= (low <= distances) & (distances <= high)
        return present

    def poses(self, times: np.ndarray, height: float) -> np.ndarray:
        """The centre poses (n, 4, 4) of a box `height` metres high that stands on the ground of this path."""
        offsets = self.offsets(times)
        poses = offset_poses(self._poses_on_path, times, offsets.lateral, offsets.lateral_speed)
        poses[:, :3, 3] += 0.5 * (height - self.height) * poses[:, :3, 2]
        return rotate_yaw(poses, offsets.yaw)

    def _poses_on_path(self, times: np.ndarray) -> np.ndarray:
        """The poses (n, 4, 4) without lateral offset and yaw."""
        position, longitudinal = self.position(times), self.offsets(times).longitudinal
        distances = self.trajectory.distance(position.clock) + position.advance + longitudinal
        deviation, weight = self.trajectory.deviation(position.clock), position.deviation_weight[:, None]
        turns = Rotation.from_matrix(deviation[:, :3, :3]).as_rotvec()
        deviation[:, :3, :3] = Rotation.from_rotvec(weight * turns).as_matrix()
        deviation[:, :3, 3] *= weight
        return self.trajectory.poses_at_distance(distances) @ deviation


def recorded_path(motion: Motion, height: float) -> ActorPath:
    """The recorded path of an object `height` metres high."""
    begin, end = motion.span
    return ActorPath(
        trajectory=ObjectTrajectory(motion),
        height=height,
        position=lambda times: PathPosition(times, np.zeros(len(times)), np.ones(len(times))),
        offsets=lambda times: PathOffsets(*np.zeros((4, len(times)))),
        recorded=motion.present,
        begin=begin,
        end=end,
    )


def end_state(motion: Motion, last: bool) -> EndState:
    """The state of a motion at its last annotation, or at its first.

    Speed and direction are linear fits to the FITTED_STEPS nearest steps between annotations; a standing object has the
    direction of its box. The slope is the height gained per horizontal metre over SLOPE_DISTANCE, 0 on a shorter path.
    """
    first, final = motion.runs[-1 if last else 0]
    indices = np.arange(first, final + 1)
    near = indices[-1 - FITTED_STEPS :] if last else indices[: 1 + FITTED_STEPS]
    end = motion.times[final if last else first]
    speed, direction = _velocity(motion.times[near] - end, motion.object_to_world[near, :2, 3])
    if speed < STANDSTILL_SPEED:
        heading = motion.poses(np.array([end]))[0, :2, 0]
        speed, direction = 0.0, heading / np.linalg.norm(heading)
    positions = motion.object_to_world[indices if last else indices[::-1], :3, 3]
    distances = np.linalg.norm(positions[:, :2] - positions[-1, :2], axis=1)
    far = np.flatnonzero(distances >= SLOPE_DISTANCE)
    slope = float((positions[-1, 2] - positions[far[-1], 2]) / distances[far[-1]]) if len(far) else 0.0
    return EndState(np.array([*direction, slope if last else -slope]), speed)


def _velocity(times: np.ndarray, positions: np.ndarray) -> tuple[float, np.ndarray]:
    """Speed in m/s and direction (2,) at second 0, fitted to `positions` (k, 2) at `times` (k,)."""
    if len(times) < 2:
        return 0.0, np.zeros(2)
    steps, middles = np.diff(positions, axis=0), (times[1:] + times[:-1]) / 2
    lengths = np.linalg.norm(steps, axis=1)
    speeds, angles = lengths / np.diff(times), np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    degree = 1 if len(steps) >= 3 else 0
    speed = _fitted(middles, speeds, degree)
    if speed < STANDSTILL_SPEED:
        return 0.0, np.zeros(2)
    angle = _fitted(middles, angles, degree if speeds.min() > MIN_TURNING_SPEED else 0, lengths)
    return speed, np.array([np.cos(angle), np.sin(angle)])


def _fitted(times: np.ndarray, values: np.ndarray, degree: int, weights: np.ndarray | None = None) -> float:
    """The value at second 0 of a polynomial fitted to `values` (k,) at `times` (k,)."""
    if len(times) == 1:  # of which numpy 1.26 makes a domain of length 0
        return float(values[0])
    return float(Polynomial.fit(times, values, degree, w=weights)(0.0))


def extrapolate(past: np.ndarray, initial: np.ndarray, steady: np.ndarray, over: float) -> np.ndarray:
    """The displacement (n, ...) at `past` (n,) an end, negative before a beginning.

    The derivative changes from `initial` (...) to `steady` (...) over the interval `over`, in the unit of `past`.
    """
    amount = np.abs(past)
    settled = Transition(0.0, over).integral(amount)
    weights = np.sign(past)[:, None] * np.stack([amount - settled, settled], axis=-1)
    return np.tensordot(weights, np.stack([initial, steady]), axes=1)


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
