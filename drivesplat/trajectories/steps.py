"""The effect of each step of an edit on an actor's path, as pure functions.

`speed` and `reverse` change the position along the path; offsets keep their film seconds. `stop` and a delay act on
position and offsets, so that a stopped actor does not slide. `place` has a path of its own: through given points, on
the ground beside the ego vehicle's path.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from drivesplat.settings.edit import Duplicate, Reverse, Shift, Speed, Stop, Waypoint
from drivesplat.trajectories.actor_path import ActorPath, PathOffsets, PathPosition
from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.transition import Transition

INTEGRATION_STEP = 0.005
"""Seconds between the samples of the distance integral during a change of speed."""
KNOT_HZ = 10.0
"""Poses a second of the motion of a placed copy."""
STANDS_S = 3600.0
"""Seconds for which a copy on a path of one point is present."""
MIN_STEP = 1e-3
"""Metres; a shorter step has no direction."""

Clock = Callable[[np.ndarray], np.ndarray]
"""Maps seconds (n,) of the path after a step to seconds (n,) of the path before it."""


def apply_speed(path: ActorPath, speed: Speed) -> ActorPath:
    """Scales the pace by a factor, or replaces it by a constant speed."""
    if speed.factor == 1.0:
        return path
    beginning = max(path.begin, 0.0)
    transition = Transition.of(speed, beginning)
    transition = Transition(max(transition.start, beginning), transition.duration)
    if speed.factor is not None:
        return _paced(path, lambda times: transition.warp_time(times, speed.factor), transition.start)
    # By partial integration, the integral of (1 - fraction) times the speed is (1 - fraction) times the distance plus
    # the integral of the fraction's rate times the distance; distances are smoother than speeds.
    start, end, velocity = transition.start, transition.start + transition.duration, path.direction * speed.to
    if transition.duration:
        during = np.linspace(start, end, max(5, int(transition.duration / INTEGRATION_STEP) + 1))
        integral = CubicSpline(during, transition.rate(during) * path.distance(during)).antiderivative()
    else:
        there = path.distance(np.array([start]))

    def position(times: np.ndarray) -> PathPosition:
        before, fraction = path.position(times), transition.fraction(times)
        recorded, remaining = path.trajectory.distance(before.clock), 1.0 - fraction
        remainder = integral(times.clip(start, end)) if transition.duration else fraction * there
        distance = remaining * (recorded + before.advance) + remainder + velocity * transition.integral(times)
        return PathPosition(before.clock, distance - recorded, before.deviation_weight * remaining)

    return replace(path, position=position, paced_from=min(path.paced_from, start))


def apply_stop(path: ActorPath, stop: Stop) -> ActorPath:
    """Reduces the pace from 1 to 0 over the duration; offsets stop changing with it."""
    transition = Transition(stop.at, stop.duration)

    def clock(times: np.ndarray) -> np.ndarray:
        return transition.warp_time(times, 0.0)

    def offsets(times: np.ndarray) -> PathOffsets:
        before = path.offsets(clock(times))
        return replace(before, lateral_speed=before.lateral_speed * (1.0 - transition.fraction(times)))

    return replace(_paced(path, clock, stop.at), offsets=offsets)


def apply_reverse(path: ActorPath, reverse: Reverse) -> ActorPath:
    """Reverses time between the first and the last second of the path."""
    reversed_path = _paced(path, lambda times: path.begin + path.end - times, -np.inf)
    reversed_path = replace(reversed_path, direction=-path.direction)
    if not reverse.turn:
        return reversed_path
    half_turn = np.pi * path.facing  # a second reversal turns back
    offsets = _added_offsets(path, lambda times: {"yaw": np.full(len(times), half_turn)})
    return replace(reversed_path, offsets=offsets, facing=-path.facing)


def apply_shift(path: ActorPath, shift: Shift) -> ActorPath:
    """Adds offsets forward along the path, to the left, and in yaw."""
    transition = Transition.of(shift, -np.inf)

    def added(times: np.ndarray) -> dict[str, np.ndarray]:
        fraction = transition.fraction(times)
        return {
            "longitudinal": path.direction * shift.longitudinal * fraction,
            "lateral": path.facing * shift.lateral * fraction,
            "lateral_speed": path.facing * shift.lateral * transition.rate(times),
            "yaw": np.radians(shift.yaw) * fraction,
        }

    return replace(path, offsets=_added_offsets(path, added))


def apply_duplicate(path: ActorPath, duplicate: Duplicate) -> ActorPath:
    """The path of a copy: `delay` seconds later, and offset from the original."""
    delay = duplicate.delay
    delayed = replace(
        path,
        position=lambda times: path.position(times - delay),
        offsets=lambda times: path.offsets(times - delay),
        recorded=lambda times: path.recorded(times) | path.recorded(times - delay),
        begin=min(path.begin, path.begin + delay),
        end=max(path.end, path.end + delay),
        paced_from=path.paced_from + delay,
    )
    if not (duplicate.longitudinal or duplicate.lateral):
        return delayed
    offset = {"longitudinal": duplicate.longitudinal, "lateral": duplicate.lateral}
    return apply_shift(delayed, Shift(track=duplicate.name, **offset))


def placed_motion(path: Sequence[Waypoint], ego_to_world: np.ndarray, height: float, yaw: float = 0.0) -> Motion:
    """The motion of a box `height` metres high along a spline through points, turned to the left by `yaw` degrees.

    `ego_to_world` (n, 4, 4) are the ego poses of the drive: its first is the frame of the points, and the nearest to
    each place has the ground's height and slope there. The box faces the direction of its path.
    """
    points = np.array(path)
    if len(points) == 1:
        times = points[0, :1] + np.array([0.0, STANDS_S])
        positions = np.repeat(points[:, 1:], 2, axis=0)
    else:
        times = np.linspace(points[0, 0], points[-1, 0], max(2, int(KNOT_HZ * np.ptp(points[:, 0])) + 1))
        positions = CubicSpline(points[:, 0], points[:, 1:], bc_type="natural")(times)
    headings, steps = np.zeros(len(positions)), np.gradient(positions, axis=0)
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) > MIN_STEP)
    if len(moving):  # where it stands, the direction of its last motion
        known = moving[np.maximum(np.searchsorted(moving, np.arange(len(positions)), side="right") - 1, 0)]
        headings = np.arctan2(steps[known, 1], steps[known, 0])
    start, poses = ego_to_world[0], np.tile(np.eye(4), (len(positions), 1, 1))
    for pose, position, heading in zip(poses, positions, headings + np.radians(yaw), strict=True):
        at = start[:3, 3] + start[:3, :3] @ np.array([*position, 0.0])
        nearest = ego_to_world[np.argmin(np.linalg.norm(ego_to_world[:, :2, 3] - at[:2], axis=1))]
        up = nearest[:3, 2]
        forward = start[:3, :3] @ np.array([np.cos(heading), np.sin(heading), 0.0])
        left = np.cross(up, forward)
        left /= np.linalg.norm(left)
        above = at[:2] - nearest[:2, 3]
        pose[:3, :3] = np.stack([np.cross(left, up), left, up], axis=1)
        pose[:3, 3] = [*at[:2], nearest[2, 3] - above @ up[:2] / up[2]]
        pose[:3, 3] += 0.5 * height * up
    return Motion(times, poses, ((0, len(times) - 1),), 0.5 / KNOT_HZ)


def _paced(path: ActorPath, clock: Clock, start: float) -> ActorPath:
    """The path whose position follows `clock`, which differs from film time from second `start` on."""
    return replace(path, position=lambda times: path.position(clock(times)), paced_from=min(path.paced_from, start))


def _added_offsets(
    path: ActorPath, added: Callable[[np.ndarray], dict[str, np.ndarray]]
) -> Callable[[np.ndarray], PathOffsets]:
    def offsets(times: np.ndarray) -> PathOffsets:
        before = path.offsets(times)
        return replace(before, **{name: getattr(before, name) + value for name, value in added(times).items()})

    return offsets
