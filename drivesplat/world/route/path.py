"""Paths in a lane of the grid: straight along streets and around corners, at a speed that curves limit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from drivesplat.scene.rigid import rigid
from drivesplat.world.route.grid import FORWARD, LEFT, Crossing, neighbour
from drivesplat.world.street.paths import LANE_CENTER, sprung

RIGHT_TURN, LEFT_TURN = 10.0, 12.0
"""Distance in metres from where a turn begins to where the lanes before and after it would meet."""
STEP = 0.5
"""Metres between the places at which the speed is known."""
SIDEWARD, FASTER, SLOWER = 2.5, 1.4, 1.8
"""Largest accelerations in m/s2: in curves, when speeding up, when braking."""
SWAY_LENGTH = 90.0
"""Metres after which the sideward motion in the lane repeats."""


def _unit_turn() -> tuple[np.ndarray, float]:
    """A quarter turn to the left from (0, 0) to (1, 1) at evenly spaced shares of its length: points (n, 2), and its
    length. The curvature rises and falls steadily, from 0 to 0."""
    shares = np.linspace(0.0, 1.0, 2001)
    heading = np.pi / 2 * _turned(shares)
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    points = np.concatenate([np.zeros((1, 2)), np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0)]) / (len(shares) - 1)
    return points / points[-1, 0], float(1.0 / points[-1, 0])


def _turned(share: np.ndarray) -> np.ndarray:
    """The share of a turn's angle after a share of its length."""
    return share**2 * (3.0 - 2.0 * share)


TURN_POINTS, TURN_LENGTH = _unit_turn()


@dataclass(frozen=True)
class LanePath:
    """A path in the grid frame from the crossing `start` along the streets of `headings`, `block_m` metres each.

    `lane` metres to the right of the middle of the street (negative: to the left), at `speed` m/s where the curve
    allows; it sways by `sway` metres. At second `when` it is `along` metres from its start. Before its start and after
    its end it goes straight on. `suspension` adds the pitch, roll and heave of a sprung vehicle. A path with turns is
    one in the right lane.
    """

    start: Crossing
    headings: tuple[int, ...]
    block_m: float
    speed: float
    lane: float = LANE_CENTER
    sway: float = 0.0
    along: float = 0.0
    when: float = 0.0
    suspension: bool = False

    @cached_property
    def _pieces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of each straight or turn: metres from the start of the path, point (2,), heading, whether it turns (+1 to the
        left, -1 to the right, 0), and length."""
        rows, crossing, offset, total = [], self.start, 0.0, 0.0
        for heading, following in zip(self.headings, [*self.headings[1:], None], strict=True):
            turn = 0 if following is None else _turn(heading, following)
            before = self._reach(turn)
            middle = self.block_m * np.array(crossing, dtype=float) - self.lane * LEFT[heading]
            length = self.block_m - offset - before
            rows.append((total, *(middle + offset * FORWARD[heading]), heading, 0, length))
            total += length
            if turn:
                size = LEFT_TURN if turn > 0 else RIGHT_TURN
                rows.append(
                    (total, *(middle + (offset + length) * FORWARD[heading]), heading, turn, size * TURN_LENGTH)
                )
                total += size * TURN_LENGTH
            crossing, offset = neighbour(crossing, heading), before
        starts, x, y, headings, turns, lengths = np.array(rows).T
        return starts, np.stack([x, y], axis=-1), headings.astype(int), turns.astype(int), lengths

    def _reach(self, turn: int) -> float:
        """Metres from the middle of a crossing at which a turn begins and ends."""
        return 0.0 if not turn else LEFT_TURN - self.lane if turn > 0 else RIGHT_TURN + self.lane

    @property
    def length(self) -> float:
        """Metres from start to end."""
        return float(self._pieces[0][-1] + self._pieces[4][-1])

    def along_at(self, index: int, offset: float) -> float:
        """Metres from the start of the path to a place `offset` metres behind the crossing at which street `index`
        begins. The place is on the straight part of the street."""
        starts, points, headings, turns, _ = self._pieces
        row = int(np.flatnonzero(turns == 0)[index])
        begin = (points[row] - self.block_m * np.array(self.crossing(index))) @ FORWARD[headings[row]]
        return float(starts[row] + offset - begin)

    def street_at(self, along: float) -> int:
        """The index of the street `along` metres from the start; in a turn, of the one to which it leads."""
        row, turns = int(self._row(np.array([along]))[0]), self._pieces[3]
        return int((turns[: row + 1] == 0).sum()) - int(turns[row] == 0)

    def crossing(self, index: int) -> Crossing:
        """The crossing at which street `index` begins."""
        east, north = (FORWARD[list(self.headings[:index])].sum(axis=0) + self.start).astype(int).tolist()
        return east, north

    def curvature(self, along: np.ndarray) -> np.ndarray:
        """Radians a metre (n,), positive to the left, `along` (n,) metres from the start."""
        starts, _, _, turns, lengths = self._pieces
        row = self._row(along)
        share = np.clip((along - starts[row]) / lengths[row], 0.0, 1.0)
        return turns[row] * np.pi / 2 * 6.0 * share * (1.0 - share) / lengths[row]

    def _row(self, along: np.ndarray) -> np.ndarray:
        return np.clip(np.searchsorted(self._pieces[0], along, side="right") - 1, 0, None)

    @cached_property
    def _timetable(self) -> tuple[np.ndarray, np.ndarray]:
        """Seconds from the start, and speed, every STEP metres (n,)."""
        places = STEP * np.arange(max(2, int(self.length / STEP) + 2))
        limit = np.minimum(self.speed**2, SIDEWARD / np.maximum(np.abs(self.curvature(places)), 1e-6))
        braking = np.minimum.accumulate((limit + 2 * SLOWER * places)[::-1])[::-1] - 2 * SLOWER * places
        squared = np.minimum.accumulate(braking - 2 * FASTER * places) + 2 * FASTER * places
        speed = np.sqrt(np.minimum(squared, limit))
        seconds = np.concatenate([[0.0], np.cumsum(2 * STEP / (speed[1:] + speed[:-1]))])
        return seconds, speed

    def seconds(self, along: float) -> float:
        """The second at which the path is `along` metres from its start."""
        table, _ = self._timetable
        places = STEP * np.arange(len(table))
        return self.when + float(np.interp(along, places, table) - np.interp(self.along, places, table))

    def distances(self, seconds: np.ndarray) -> np.ndarray:
        """Metres (n,) from the start of the path at `seconds` (n,)."""
        table, speed = self._timetable
        since = (
            np.asarray(seconds, dtype=float) - self.when + np.interp(self.along, STEP * np.arange(len(table)), table)
        )
        row = np.clip(np.searchsorted(table, since, side="right") - 1, 0, len(table) - 2)
        elapsed = since - table[row]
        acceleration = (speed[row + 1] ** 2 - speed[row] ** 2) / (2 * STEP)
        inside = (since >= table[0]) & (since <= table[-1])
        return STEP * row + elapsed * speed[row] + np.where(inside, 0.5 * acceleration * elapsed**2, 0.0)

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        """Metres travelled since `when` (n,)."""
        return np.abs(self.distances(seconds) - self.along)

    def places(self, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 2) in the grid frame and directions (n,) in radians to the left of the east, `along` (n,) metres
        from the start."""
        starts, points, headings, turns, lengths = self._pieces
        row = self._row(along)
        past = along - starts[row]
        share = past / lengths[row]
        # of a turn: where it leads within the square around it, and how far it has turned
        table = np.linspace(0.0, 1.0, len(TURN_POINTS))
        within = np.stack([np.interp(share, table, TURN_POINTS[:, axis]) for axis in (0, 1)], axis=-1)
        within *= (lengths[row] / TURN_LENGTH)[:, None]
        turning = turns[row] != 0
        ahead = np.where(turning, within[:, 0], past)
        aside = np.where(turning, turns[row] * within[:, 1], 0.0)
        angle = np.pi / 2 * (headings[row] + turns[row] * _turned(np.clip(share, 0.0, 1.0)))
        heading = FORWARD[headings[row]], LEFT[headings[row]]
        places = points[row] + ahead[:, None] * heading[0] + aside[:, None] * heading[1]
        wave = 2 * np.pi / SWAY_LENGTH
        left = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        places = places + self.sway * np.sin(wave * along)[:, None] * left
        return places, angle + np.arctan(self.sway * wave * np.cos(wave * along))

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to grid (n, 4, 4): on the ground, facing along the path."""
        places, angle = self.places(self.distances(seconds))
        rotations = np.zeros((len(angle), 3, 3))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angle)
        rotations[:, 1, 0], rotations[:, 0, 1], rotations[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
        poses = rigid(rotations, np.concatenate([places, np.zeros((len(angle), 1))], axis=1))
        return sprung(poses, seconds) if self.suspension else poses

    def meeting(self, along: float, second: float) -> "LanePath":
        """The path at another time: at `second` it is `along` metres from its start."""
        return replace(self, along=along, when=second)


def turns_of(headings: Sequence[int]) -> list[int]:
    """The turn between each two headings: +1 to the left, -1 to the right, 0 straight on."""
    return [_turn(a, b) for a, b in pairwise(headings)]


def _turn(heading: int, following: int) -> int:
    turn = (following - heading + 1) % 4 - 1
    if turn == 2:
        raise ValueError("a path does not turn round at a crossing")
    return turn
