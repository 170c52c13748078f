"""What each step of an edit does to a way: pure functions from one way to the next.

`speed` and `reverse` change how far an actor has come, and leave what lies beside its path at its second of the film.
`stop` and a delay take the whole way with them: what rests does not slide.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from drivesplat.editing.easing import Onset
from drivesplat.editing.path import Offsets, Progress, Way
from drivesplat.settings.edit import Duplicate, Reverse, Shift, Speed, Stop

INTEGRATED = 0.005
"""Seconds between the places from which the way during a change of speed is integrated."""

Clock = Callable[[np.ndarray], np.ndarray]
"""Which second of the way before a step (n,) the way after it is at, at seconds (n,)."""


def sped(way: Way, speed: Speed) -> Way:
    """Faster or slower: by a factor it lives through its way at another pace; at a speed of its own it leaves the
    recorded pace behind."""
    if speed.factor == 1.0:
        return way
    beginning = max(way.begin, 0.0)
    onset = Onset.of(speed, beginning)
    onset = Onset(max(onset.start, beginning), onset.duration)
    if speed.factor is None:
        return _at_own_speed(way, onset, way.direction * speed.to)
    return _paced(way, lambda at: onset.paced(at, speed.factor), onset.start)


def stopped(way: Way, stop: Stop) -> Way:
    """Its pace falls from 1 to 0 over the duration, and with it everything else that it does."""
    onset = Onset(stop.at, stop.duration)

    def offsets(at: np.ndarray) -> Offsets:
        then = way.offsets(onset.paced(at, 0.0))
        return replace(then, drift=then.drift * (1.0 - onset.share(at)))

    return replace(_paced(way, lambda at: onset.paced(at, 0.0), stop.at), offsets=offsets)


def reversed_way(way: Way, reverse: Reverse) -> Way:
    """Time runs backwards between its first and its last second."""
    back = _paced(way, lambda at: way.begin + way.end - at, -np.inf)
    back = replace(back, direction=-way.direction)
    if not reverse.turn:
        return back
    half_turn = np.pi * way.faces  # there and back again
    return replace(back, offsets=_added(way, lambda at: {"yaw": np.full(len(at), half_turn)}), faces=-way.faces)


def shifted(way: Way, shift: Shift) -> Way:
    """Further on along its way, to its left, and turned."""
    onset = Onset.of(shift, -np.inf)

    def more(at: np.ndarray) -> dict[str, np.ndarray]:
        share = onset.share(at)
        return {
            "ahead": way.direction * shift.longitudinal * share,
            "lateral": way.faces * shift.lateral * share,
            "drift": way.faces * shift.lateral * onset.rate(at),
            "yaw": np.radians(shift.yaw) * share,
        }

    return replace(way, offsets=_added(way, more))


def copied(way: Way, duplicate: Duplicate) -> Way:
    """The way of a copy: everything `delay` seconds later, and beside the original."""
    delay = duplicate.delay

    def clock(at: np.ndarray) -> np.ndarray:
        return at - delay

    later = replace(
        way,
        progress=lambda at: way.progress(clock(at)),
        offsets=lambda at: way.offsets(clock(at)),
        recorded=lambda at: way.recorded(at) | way.recorded(clock(at)),
        begin=min(way.begin, way.begin + delay),
        end=max(way.end, way.end + delay),
        since=way.since + delay,
    )
    if not (duplicate.longitudinal or duplicate.lateral):
        return later
    offset = {"longitudinal": duplicate.longitudinal, "lateral": duplicate.lateral}
    return shifted(later, Shift(track=duplicate.name, **offset))


def _paced(way: Way, clock: Clock, since: float) -> Way:
    """A way whose progress at a second is that of `way` when `clock` says, from second `since` on another."""
    return replace(way, progress=lambda at: way.progress(clock(at)), since=min(way.since, since))


def _at_own_speed(way: Way, onset: Onset, velocity: float) -> Way:
    """Along its course at `velocity` (m/s, negative: backwards), to which the speed changes from what it would be."""
    left_behind = _integral(way, onset)

    def progress(at: np.ndarray) -> Progress:
        old, remaining = way.progress(at), 1.0 - onset.share(at)
        there = way.course.metres(old.clock)
        metres = remaining * (there + old.along) + left_behind(at) + velocity * onset.elapsed(at)
        return Progress(old.clock, metres - there, old.faithful * remaining)

    return replace(way, progress=progress, since=min(way.since, onset.start))


def _integral(way: Way, onset: Onset) -> Callable[[np.ndarray], np.ndarray]:
    """The integral up to the seconds (n,) of the rate of `onset` times the metres of `way`: (n,).

    By parts, the integral of (1 - share) times the way's speed is (1 - share) times its metres plus this: metres are
    smoother than speeds.
    """
    end = onset.start + onset.duration
    if not onset.duration:
        place = way.metres(np.array([onset.start]))
        return lambda at: onset.share(at) * place
    during = np.linspace(onset.start, end, max(5, int(onset.duration / INTEGRATED) + 1))
    integral = CubicSpline(during, onset.rate(during) * way.metres(during)).antiderivative()
    return lambda at: integral(at.clip(onset.start, end))


def _added(way: Way, more: Callable[[np.ndarray], dict[str, np.ndarray]]) -> Callable[[np.ndarray], Offsets]:
    """The offsets of `way` and `more`."""

    def offsets(at: np.ndarray) -> Offsets:
        old = way.offsets(at)
        return replace(old, **{name: getattr(old, name) + value for name, value in more(at).items()})

    return offsets
