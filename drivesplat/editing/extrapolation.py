"""How an object goes on past the ends of its track: steadily, however its annotations tremble there.

The motion between annotations swings from one to the next; its speed at the very end is as good as two boxes are. Ten
seconds on, centimetres of theirs would be metres.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from drivesplat.editing.easing import Onset
from drivesplat.scene.motion import Motion

LOOKS_BACK = 4
"""Steps from annotation to annotation from which speed and direction at an end are taken."""
STANDS = 0.5
"""Speed (m/s) under which what a track ends with stands: boxes that tremble by 5 cm make less."""
DRIVES = 1.0
"""Speed (m/s) from which on a bend is told from trembling."""
GRADE_OVER = 20.0
"""Metres over which the climb at an end is taken; what came less far goes on level."""


@dataclass(frozen=True)
class End:
    """How it goes on at the first or last annotation: `direction` (3,) in the world, horizontally of length 1, and
    `speed` in m/s, horizontally along it; 0 for what stands. Both as time goes."""

    direction: np.ndarray
    speed: float

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s."""
        return self.speed * self.direction

    def after(self, momentary: np.ndarray) -> np.ndarray:
        """Where (3,) a path that leads `momentary` (3,) there goes on: what stands may have come backwards."""
        backwards = not self.speed and momentary[:2] @ self.direction[:2] < 0.0
        return self.direction * [-1.0, -1.0, 1.0] if backwards else self.direction


def end_of(motion: Motion, last: bool) -> End:
    """How a motion goes on at its last annotation, or before its first.

    Speed and direction of the LOOKS_BACK nearest steps between annotations are taken to change evenly towards the end;
    what stands goes where its box points. It climbs as it did over GRADE_OVER.
    """
    first, final = motion.runs[-1 if last else 0]
    indices = np.arange(first, final + 1)
    near = indices[-1 - LOOKS_BACK :] if last else indices[: 1 + LOOKS_BACK]
    end = motion.times[final if last else first]
    speed, direction = _velocity(motion.times[near] - end, motion.object_to_world[near, :2, 3])
    if speed < STANDS:
        heading = motion.poses(np.array([end]))[0, :2, 0]
        speed, direction = 0.0, heading / np.linalg.norm(heading)
    climb = _climb(motion.object_to_world[indices if last else indices[::-1], :3, 3])
    return End(np.array([*direction, climb if last else -climb]), speed)


def _velocity(times: np.ndarray, places: np.ndarray) -> tuple[float, np.ndarray]:
    """Speed in m/s and direction (2,) at second 0, of what was at `places` (k, 2) at `times` (k,)."""
    if len(times) < 2:
        return 0.0, np.zeros(2)
    steps, middles = np.diff(places, axis=0), (times[1:] + times[:-1]) / 2
    lengths = np.linalg.norm(steps, axis=1)
    speeds, angles = lengths / np.diff(times), np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    degree = 1 if len(steps) >= 3 else 0
    speed = float(Polynomial.fit(middles, speeds, degree)(0.0))
    if speed < STANDS:
        return 0.0, np.zeros(2)
    angle = Polynomial.fit(middles, angles, degree if speeds.min() > DRIVES else 0, w=lengths)(0.0)
    return speed, np.array([np.cos(angle), np.sin(angle)])


def _climb(places: np.ndarray) -> float:
    """Metres up per metre on towards the last of `places` (m, 3), over the last GRADE_OVER metres; 0 where it came less
    far."""
    far = np.linalg.norm(places[:, :2] - places[-1, :2], axis=1)
    enough = np.flatnonzero(far >= GRADE_OVER)
    return float((places[-1, 2] - places[enough[-1], 2]) / far[enough[-1]]) if len(enough) else 0.0


def onward(past: np.ndarray, momentary: np.ndarray, steady: np.ndarray, over: float) -> np.ndarray:
    """How far what was `momentary` (...) comes while it becomes `steady` (...), over as much as `over` past an end:
    (n, ...) at `past` (n,), negative before a beginning."""
    amount = np.abs(past)
    settled = Onset(0.0, over).elapsed(amount)
    shares = np.sign(past)[:, None] * np.stack([amount - settled, settled], axis=-1)
    return np.tensordot(shares, np.stack([momentary, steady]), axes=1)
