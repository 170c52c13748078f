"""Vehicles and people who move near the ego vehicle, each for some seconds.

A road user is drawn for a second of the drive, at which it meets the ego vehicle. Before and after it, houses or
distance hide it; in between it exists. A road user that would come too close to another one is left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from drivesplat.settings.world import WorldSettings
from drivesplat.world.route.grid import FORWARD, hidden, neighbour
from drivesplat.world.route.path import LanePath
from drivesplat.world.route.scenery import MAKES, vehicle_of
from drivesplat.world.shapes.body import Body, RigidBody
from drivesplat.world.shapes.cyclist import Cyclist
from drivesplat.world.shapes.people import Person
from drivesplat.world.street.people import CYCLING_SPEED, WALKWAYS

PERIOD_S = 10.0
"""The settings count road users for so many seconds of the drive."""
MAX_LIFE_S = 26.0
"""Largest number of seconds before and after the meeting that a road user may exist."""
FAR = {"vehicle": 150.0, "cyclist": 90.0, "pedestrian": 90.0}
"""Metres from which a road user may appear and disappear in view."""
CHECK_S = 0.2
"""Interval in seconds at which distances are checked."""
LIFE_STEP_S = 0.5
"""Interval in seconds at which the view of a road user is checked."""
ATTEMPTS = 4
"""Number of places that are drawn for a road user until one fits."""
CYCLING_AT = 3.4
"""Distance in metres of cyclists from the middle of the street."""
STREETS = 4
"""Number of streets of a vehicle's path before and after the one of the meeting."""
STRAIGHT_ON = 0.6
"""Probability that a vehicle goes straight on at a crossing."""
SIDEWALK_ENDS = 13.0
"""Metres from the middle of a crossing within which nobody walks."""
GAP = {"vehicle": 0.8, "cyclist": 0.15, "pedestrian": 0.3}
"""Least distance in metres to others, the smaller one of two kinds."""
EXTENTS = {"car": (4.9, 1.95), "van": (6.0, 2.15), "cyclist": (1.9, 0.7), "pedestrian": (0.95, 0.75)}
"""Largest length and width of what is drawn."""
EGO_EXTENT, EGO_CENTER = (4.6, 1.9), 1.4
"""Of the ego vehicle, and the distance in metres of its middle from its origin."""
CATEGORY = "human.pedestrian.adult"


@dataclass(frozen=True)
class RoadUser:
    """A vehicle or person. `kind`: a key of EXTENTS. `seed` determines its looks. It exists from second `begin` to
    `end`; `path` is in the grid frame."""

    name: str
    kind: str
    path: LanePath
    seed: tuple[int, ...]
    begin: float = -np.inf
    end: float = np.inf

    @property
    def group(self) -> str:
        """Its key of GAP."""
        return self.kind if self.kind in GAP else "vehicle"

    def body(self) -> tuple[Body, str, str]:
        """Its body, nuScenes' category and attribute."""
        random = np.random.default_rng(self.seed)
        if self.kind == "pedestrian":
            return Person.drawn(random), CATEGORY, "pedestrian.moving"
        if self.kind == "cyclist":
            return Cyclist.drawn(random), "vehicle.bicycle", "cycle.with_rider"
        mesh, category = vehicle_of(self.kind, int(random.integers(MAKES)))
        return RigidBody(mesh), category, "vehicle.moving"


@dataclass(frozen=True)
class _Meeting:
    """Where the ego vehicle is at a `second`: its street by index, and its distance in metres from the crossing where
    this street begins."""

    second: float
    street: int
    offset: float


class RoadUsers:
    """The road users of a drive of `seconds`. Those near any second of it are the same in a longer drive."""

    def __init__(self, world: WorldSettings, ego: LanePath, seconds: float):
        assert world.route is not None
        self._world, self._ego, self._block = world, ego, world.route.block_m
        self.users: list[RoadUser] = []
        self._recent: list[RoadUser] = []
        for period in range(int((seconds + MAX_LIFE_S) / PERIOD_S) + 1):
            self._recent = [user for user in self._recent if user.end > PERIOD_S * period - MAX_LIFE_S]
            for number, (kind, second) in enumerate(self._wanted(period)):
                random = np.random.default_rng([world.random_seed, 2, period, number])
                found = (self._drawn(kind, f"{kind} {period}.{number}", second, random) for _ in range(ATTEMPTS))
                free = next((user for user in found if user is not None and self._is_free(user)), None)
                if free is not None:
                    self.users.append(free)
                    self._recent.append(free)

    def near(self, begin: float, end: float) -> list[RoadUser]:
        """Those that exist at some second from `begin` to `end`."""
        return [user for user in self.users if user.begin <= end and user.end >= begin]

    def _wanted(self, period: int) -> Iterator[tuple[str, float]]:
        """Kind and second of the meeting of each road user of a period, evenly spread over it."""
        world = self._world
        groups = {"vehicle": world.vehicles, "pedestrian": world.pedestrians, "cyclist": world.cyclists}
        for kind, wanted in groups.items():
            for k in range(wanted):
                yield kind, PERIOD_S * (period + (k + 0.5) / wanted)

    def _drawn(self, kind: str, name: str, second: float, random: np.random.Generator) -> RoadUser | None:
        """A road user who meets the ego vehicle at about a second; None if the place that was drawn does not fit."""
        meeting = self._meeting(second)
        draw = {"vehicle": self._vehicle, "cyclist": self._cyclist, "pedestrian": self._pedestrian}
        exact_kind, path = draw[kind](meeting, random)
        user = RoadUser(name, exact_kind, path, tuple(random.integers(2**31, size=2).tolist()))
        life = self._life(user, second)
        if life is None or not all(self._is_on_its_street(user, at) for at in life):
            return None
        return replace(user, begin=life[0], end=life[1])

    def _meeting(self, second: float) -> _Meeting:
        """The street on which the ego vehicle is at a second; around a corner, the one into which it turns."""
        along = self._ego.distances(np.array([second]))
        index, place = self._ego.street_at(float(along[0])), self._ego.places(along)[0][0]
        start = self._block * np.array(self._ego.crossing(index))
        return _Meeting(second, index, float((place - start) @ FORWARD[self._ego.headings[index]]))

    def _vehicle(self, meeting: _Meeting, random: np.random.Generator) -> tuple[str, LanePath]:
        """A vehicle that drives ahead of the ego vehicle or comes towards it, and turns at some crossings."""
        oncoming = bool(random.random() < 0.5)
        ahead = random.uniform(25.0, 90.0) if oncoming else random.uniform(13.0, 45.0)
        kind = "van" if random.random() < 0.3 else "car"
        speed = self._ego.speed * random.uniform(0.85, 1.0)
        heading, passed = self._ego.headings[meeting.street], int((meeting.offset + ahead) // self._block)
        crossing = self._ego.crossing(meeting.street)
        for _ in range(passed):
            crossing = neighbour(crossing, heading)
        offset = meeting.offset + ahead - passed * self._block
        if oncoming:
            crossing, heading, offset = neighbour(crossing, heading), (heading + 2) % 4, self._block - offset
        headings = [heading]
        for _ in range(STREETS):
            headings.append((headings[-1] + self._turn(random)) % 4)
            headings.insert(0, (headings[0] + self._turn(random)) % 4)
            crossing = neighbour(crossing, headings[0] + 2)
        path = LanePath(crossing, tuple(headings), self._block, speed, sway=0.1)
        return kind, path.meeting(path.along_at(STREETS, offset), meeting.second)

    def _cyclist(self, meeting: _Meeting, random: np.random.Generator) -> tuple[str, LanePath]:
        """A cyclist who rides straight on beside the cars."""
        heading, crossing = self._ego.headings[meeting.street], self._ego.crossing(meeting.street)
        offset = meeting.offset + random.uniform(9.0, 25.0)
        if random.random() < 0.5:
            crossing, heading, offset = neighbour(crossing, heading), (heading + 2) % 4, self._block - offset
        path = LanePath(crossing, (heading,), self._block, CYCLING_SPEED, CYCLING_AT)
        return "cyclist", path.meeting(offset, meeting.second)

    def _pedestrian(self, meeting: _Meeting, random: np.random.Generator) -> tuple[str, LanePath]:
        """A pedestrian who walks along one side of the street, on one of the walkways of the settings."""
        walkways = [walkway for walkway in WALKWAYS if walkway.place in self._world.walkways]
        walkway = walkways[random.integers(len(walkways))]
        heading, crossing = self._ego.headings[meeting.street], self._ego.crossing(meeting.street)
        offset, lane = meeting.offset + walkway.ahead + random.uniform(0.0, 22.0), -walkway.t
        if offset > self._block:
            crossing, offset = neighbour(crossing, heading), offset - self._block
        if walkway.speed < 0.0:  # towards the ego vehicle
            crossing, heading = neighbour(crossing, heading), (heading + 2) % 4
            offset, lane = self._block - offset, -lane
        path = LanePath(crossing, (heading,), self._block, abs(walkway.speed), lane)
        return "pedestrian", path.meeting(offset, meeting.second)

    def _turn(self, random: np.random.Generator) -> int:
        return 0 if random.random() < STRAIGHT_ON else int(random.choice([-1, 1]))

    def _is_on_its_street(self, user: RoadUser, second: float) -> bool:
        """Whether one who walks is between the crossings of the street."""
        if user.kind != "pedestrian":
            return True
        along = float(user.path.distances(np.array([second]))[0])
        return SIDEWALK_ENDS < along < self._block - SIDEWALK_ENDS

    def _life(self, user: RoadUser, second: float) -> tuple[float, float] | None:
        """The first and the last second at which it exists; None if it is in view for too long, or not at all."""
        steps = np.arange(0.0, MAX_LIFE_S, LIFE_STEP_S)
        found = []
        for sign in (-1.0, 1.0):
            times = second + sign * steps
            ego, own = (path.poses(times)[:, :2, 3] for path in (self._ego, user.path))
            away = np.linalg.norm(own - ego, axis=1) > FAR[user.group]
            unseen = np.flatnonzero(away | hidden(ego, own, self._block))
            if not len(unseen) or unseen[0] == 0:
                return None
            found.append(float(times[unseen[0]]))
        return found[0], found[1]

    def _is_free(self, user: RoadUser) -> bool:
        """Whether it keeps its distance to the ego vehicle and to all others while it exists."""
        times = np.arange(user.begin, user.end, CHECK_S)
        own = rectangles(user, times)
        if _gap(own, ego_rectangles(self._ego, times)).min() < GAP[user.group]:
            return False
        for other in self._recent:
            both = (times >= other.begin - CHECK_S) & (times <= other.end + CHECK_S)
            least = min(GAP[user.group], GAP[other.group])
            if both.any() and _gap(own[both], rectangles(other, times[both])).min() < least:
                return False
        return True


def rectangles(user: RoadUser, seconds: np.ndarray) -> np.ndarray:
    """Centre, forward half and left half (n, 3, 2) of a road user's ground rectangle in the grid frame."""
    return _rectangles(user.path.poses(seconds), EXTENTS[user.kind])


def ego_rectangles(ego: LanePath, seconds: np.ndarray) -> np.ndarray:
    """The same (n, 3, 2) of the ego vehicle."""
    poses = ego.poses(seconds)
    poses[:, :2, 3] += EGO_CENTER * poses[:, :2, 0]
    return _rectangles(poses, EGO_EXTENT)


def _rectangles(poses: np.ndarray, extent: tuple[float, float]) -> np.ndarray:
    halves = [poses[:, :2, axis] * extent[axis] / 2 for axis in (0, 1)]
    return np.stack([poses[:, :2, 3], *halves], axis=1)


def _gap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The distance (n,) of rectangles (n, 3, 2) along the axis that separates them best; negative if they overlap."""
    between, separations = b[:, 0] - a[:, 0], []
    for half in (a[:, 1], a[:, 2], b[:, 1], b[:, 2]):
        axis = half / np.linalg.norm(half, axis=1, keepdims=True)
        reach = sum(np.abs((h * axis).sum(axis=1)) for h in (a[:, 1], a[:, 2], b[:, 1], b[:, 2]))
        separations.append(np.abs((between * axis).sum(axis=1)) - reach)
    return np.max(separations, axis=0)
