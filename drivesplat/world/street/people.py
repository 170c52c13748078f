"""Pedestrians, bystanders, cyclists and dogs: placed where the front camera sees them in held-out frames."""

from dataclasses import dataclass
from itertools import count

import numpy as np

from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.world import WalkwayPlace, WorldSettings
from drivesplat.world.layout import CYCLE_LANE, ROADSIDE, SIDEWALK_PATH, WALL_SIDE
from drivesplat.world.shapes.animals import Dog
from drivesplat.world.shapes.cyclist import Cyclist
from drivesplat.world.shapes.people import Person
from drivesplat.world.street.objects import StreetObject
from drivesplat.world.street.paths import StreetPath
from drivesplat.world.street.road import ReferenceLine

CYCLING_SPEED = 4.2
BYSTANDER_AHEAD, CYCLIST_AHEAD = 15.0, 9.0
"""Metres ahead of the ego vehicle at which they are placed."""
DOG_LEAD = 1.4
"""Metres that a dog is ahead of its owner."""
AT_ONCE_S, ABREAST = 0.45, 1.5
"""People within so many seconds take different walkways, and more than these keep so many metres between them."""


@dataclass(frozen=True)
class Walkway:
    """Where pedestrians walk: on the road beside parked vehicles or on the sidewalk (`place`), `t` metres to the left
    of the centre line, at `speed` m/s along the road.

    One is placed `ahead` metres of the ego vehicle, just within the front camera's field of view. All in one walkway
    have the same speed, so that they keep their distances.
    """

    place: WalkwayPlace
    t: float
    speed: float
    ahead: float


WALKWAYS = (
    Walkway("road", -ROADSIDE, -1.25, 8.0),
    Walkway("sidewalk", -SIDEWALK_PATH, 1.45, 12.0),
    Walkway("road", ROADSIDE, 1.3, 12.0),
    Walkway("sidewalk", SIDEWALK_PATH, -1.4, 18.0),
)


@dataclass(frozen=True)
class Encounter:
    """The second of the drive at which somebody is close ahead of the ego vehicle, and how many are before them within
    AT_ONCE_S."""

    second: float
    before: int


def people(
    world: WorldSettings, road: ReferenceLine, ego: StreetPath, random: np.random.Generator
) -> list[StreetObject]:
    """Pedestrians, bystanders, cyclists and dogs."""
    distance = ABREAST if not world.dogs else 2 * ABREAST
    walkers: list[StreetObject] = []
    # each pedestrian is in the first walkway where the others keep their distance
    walkways = [walkway for walkway in WALKWAYS if walkway.place in world.walkways]
    walking: dict[Walkway, list[float]] = {walkway: [] for walkway in walkways}
    for index, met in enumerate(encounters(world, world.pedestrians)):
        places = ((number // len(walkways), walkways[number % len(walkways)]) for number in count(met.before))
        starts = ((w, _place(ego, met, w.ahead + ABREAST * row) - w.speed * met.second) for row, w in places)
        walkway, start = next((w, s) for w, s in starts if all(abs(s - other) >= distance for other in walking[w]))
        walking[walkway].append(start)
        path = StreetPath(start, walkway.t, walkway.speed, road=road)
        body = Person.drawn(random, walks=True)
        walkers.append(StreetObject(f"pedestrian {index}", body, path, "human.pedestrian.adult", "pedestrian.moving"))
    found = [*walkers]
    standing: dict[int, list[float]] = {-1: [], 1: []}
    for index, met in enumerate(encounters(world, world.bystanders)):  # on both sides, at the first free place
        start = _place(ego, met, BYSTANDER_AHEAD)
        sides = ((side, start + ABREAST * row) for row in range(world.bystanders) for side in (-1, 1))
        side, place = next((a, s) for a, s in sides if all(abs(s - other) >= ABREAST for other in standing[a]))
        standing[side].append(place)
        path = StreetPath(
            place, side * WALL_SIDE, heading=-side * np.pi / 2, turning=random.uniform(0.6, 1.2),
            period=random.uniform(5.0, 8.0), road=road,
        )  # fmt: skip
        body = Person.drawn(random, walks=False)
        found.append(StreetObject(f"bystander {index}", body, path, "human.pedestrian.adult", "pedestrian.standing"))
    for index, met in enumerate(encounters(world, world.cyclists)):
        side = (-1) ** (index + 1)
        speed = -side * CYCLING_SPEED
        place = _place(ego, met, CYCLIST_AHEAD + 2 * ABREAST * (met.before // 2))
        path = StreetPath(place - speed * met.second, side * CYCLE_LANE, speed, road=road)
        body = Cyclist.drawn(random)
        found.append(StreetObject(f"cyclist {index}", body, path, "vehicle.bicycle", "cycle.with_rider"))
    for index, owner in enumerate(walkers[: world.dogs]):
        walk = owner.path
        path = StreetPath(walk.s + np.sign(walk.speed) * DOG_LEAD, walk.t, walk.speed, road=walk.road)
        found.append(StreetObject(f"dog {index}", Dog.drawn(random), path, "animal"))
    return found


def encounters(world: WorldSettings, number: int) -> list[Encounter]:
    """When each of so many people is met: one half at frames that the default protocol holds out between training
    frames, the other at frames of its last block."""
    groups = HoldoutSettings().held_out(world.key_frames)
    between, last = groups["interpolation"], groups["extrapolation"]
    half = -(-number // 2) if between else 0
    shares = ((between, half), (last, number - half))
    frames = [frames[k * len(frames) // share] for frames, share in shares for k in range(share)]
    seconds = [frame / world.key_frame_hz for frame in frames]
    return [
        Encounter(second, sum(abs(second - earlier) < AT_ONCE_S for earlier in seconds[:i]))
        for i, second in enumerate(seconds)
    ]


def _place(ego: StreetPath, met: Encounter, ahead: float) -> float:
    """The place s (metres) of an encounter."""
    return float(ego.along(np.array([met.second]))[0]) + ahead
