"""Pedestrians, bystanders, cyclists and dogs: placed where the front camera sees them in held-out frames."""

from dataclasses import dataclass
from itertools import count

import numpy as np

from drivesplat.scene.splits import held_out_key_frames
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
    walkers = _walkers(world, road, ego, random)
    standing = _bystanders(encounters(world, world.bystanders), road, ego, random)
    cyclists = [_cyclist(i, met, road, ego, random) for i, met in enumerate(encounters(world, world.cyclists))]
    dogs = [_dog(i, walkers[i], random) for i in range(min(world.dogs, len(walkers)))]
    return [*walkers, *standing, *cyclists, *dogs]


def encounters(world: WorldSettings, number: int) -> list[Encounter]:
    """When each of so many people is met: one half at frames that the default protocol holds out between training
    frames, the other at frames of its last block."""
    groups = held_out_key_frames(world.key_frames, HoldoutSettings())
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


def _walkers(
    world: WorldSettings, road: ReferenceLine, ego: StreetPath, random: np.random.Generator
) -> list[StreetObject]:
    """Pedestrians, each in the first walkway where the others keep their distance."""
    distance = ABREAST if not world.dogs else 2 * ABREAST
    found: list[StreetObject] = []
    walkways = [walkway for walkway in WALKWAYS if walkway.place in world.walkways]
    taken: dict[Walkway, list[float]] = {walkway: [] for walkway in walkways}
    for index, met in enumerate(encounters(world, world.pedestrians)):
        places = (divmod(number, len(walkways)) for number in count(met.before))
        starts = ((walkways[number], _start(met, walkways[number], row, ego)) for row, number in places)
        walkway, start = next((w, s) for w, s in starts if all(abs(s - other) >= distance for other in taken[w]))
        taken[walkway].append(start)
        path = StreetPath(start, walkway.t, walkway.speed, road=road)
        body = Person.drawn(random, walks=True)
        found.append(StreetObject(f"pedestrian {index}", body, path, "human.pedestrian.adult", "pedestrian.moving"))
    return found


def _start(met: Encounter, walkway: Walkway, row: int, ego: StreetPath) -> float:
    """The place s (metres) at second 0 of a pedestrian who is met in a walkway."""
    return _place(ego, met, walkway.ahead + ABREAST * row) - walkway.speed * met.second


def _bystanders(
    met: list[Encounter], road: ReferenceLine, ego: StreetPath, random: np.random.Generator
) -> list[StreetObject]:
    """Bystanders on both sides, each at the first place that is free."""
    found: list[StreetObject] = []
    taken: dict[int, list[float]] = {-1: [], 1: []}
    for index, encounter in enumerate(met):
        start = _place(ego, encounter, BYSTANDER_AHEAD)
        places = ((side, start + ABREAST * row) for row in range(len(met)) for side in (-1, 1))
        side, place = next((a, s) for a, s in places if all(abs(s - other) >= ABREAST for other in taken[a]))
        taken[side].append(place)
        found.append(_bystander(index, side, place, road, random))
    return found


def _bystander(index: int, side: int, place: float, road: ReferenceLine, random: np.random.Generator) -> StreetObject:
    path = StreetPath(
        place, side * WALL_SIDE, heading=-side * np.pi / 2, turning=random.uniform(0.6, 1.2),
        period=random.uniform(5.0, 8.0), road=road,
    )  # fmt: skip
    body = Person.drawn(random, walks=False)
    return StreetObject(f"bystander {index}", body, path, "human.pedestrian.adult", "pedestrian.standing")


def _cyclist(
    index: int, met: Encounter, road: ReferenceLine, ego: StreetPath, random: np.random.Generator
) -> StreetObject:  # fmt: skip
    side = (-1) ** (index + 1)
    speed = -side * CYCLING_SPEED
    place = _place(ego, met, CYCLIST_AHEAD + 2 * ABREAST * (met.before // 2))
    path = StreetPath(place - speed * met.second, side * CYCLE_LANE, speed, road=road)
    return StreetObject(f"cyclist {index}", Cyclist.drawn(random), path, "vehicle.bicycle", "cycle.with_rider")


def _dog(index: int, owner: StreetObject, random: np.random.Generator) -> StreetObject:
    walk = owner.path
    path = StreetPath(walk.s + np.sign(walk.speed) * DOG_LEAD, walk.t, walk.speed, road=walk.road)
    return StreetObject(f"dog {index}", Dog.drawn(random), path, "animal")
