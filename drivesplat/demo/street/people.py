"""Pedestrians, bystanders, cyclists and dogs: placed where the front camera sees them, one after the other."""

import numpy as np

from drivesplat.demo.shapes.animals import Dog
from drivesplat.demo.shapes.cyclist import Cyclist
from drivesplat.demo.shapes.people import Person
from drivesplat.demo.street.layout import WALKWAY, WALL_SIDE
from drivesplat.demo.street.objects import StreetObject
from drivesplat.demo.street.paths import StreetPath
from drivesplat.demo.street.road import Road
from drivesplat.settings.world import WorldSettings

WALKING_SPEED = {-1: 1.25, 1: 1.45}
"""Speed (m/s) of all pedestrians on a side of the road, so that they keep their distances."""
CYCLING_SPEED = 4.2
CYCLE_LANE = 3.4
"""Distance (metres) of cyclists from the centre line."""
AHEAD = (8.0, 13.0)
"""Nearest and farthest metres ahead of the camera at which someone is placed at their moment."""
DOG_LEAD = 1.4
"""Metres that a dog is ahead of its owner."""


def people(world: WorldSettings, road: Road, ego: StreetPath, random: np.random.Generator) -> list[StreetObject]:
    """All of them. Each is `AHEAD` of the ego vehicle at a moment of their own, evenly spread over the drive."""
    walkers = [_walker(world, road, ego, i, random) for i in range(world.pedestrians)]
    standing = [_bystander(world, road, ego, i, random) for i in range(world.bystanders)]
    cyclists = [_cyclist(world, road, ego, i, random) for i in range(world.cyclists)]
    dogs = [_dog(i, walkers[i], random) for i in range(min(world.dogs, len(walkers)))]
    return [*walkers, *standing, *cyclists, *dogs]


def _encounter(
    world: WorldSettings, ego: StreetPath, index: int, count: int, random: np.random.Generator
) -> tuple[float, float]:
    """The second of the drive at which one of `count` is ahead of the ego vehicle, and their place s (metres) then."""
    second = (index + 0.5) / count * world.seconds
    spread = random.uniform(*AHEAD) if ego.speed > 3.0 else random.uniform(AHEAD[0] - 2.0, AHEAD[1] + 12.0)
    return second, float(ego.along(np.array([second]))[0]) + spread


def _walker(world: WorldSettings, road: Road, ego: StreetPath, index: int, random: np.random.Generator) -> StreetObject:
    side = (-1) ** (index + 1)
    second, place = _encounter(world, ego, index, world.pedestrians, random)
    if ego.speed <= 3.0:  # nobody passes: they keep a distance of their own
        place = ego.s + AHEAD[0] - 2.0 + 3.5 * (index // 2) + 0.5 * side
    speed = -side * WALKING_SPEED[side]
    t = side * (WALKWAY + random.uniform(-0.05, 0.05))
    path = StreetPath(place - speed * second, t, speed, road=road)
    body = Person.drawn(random, walks=True)
    return StreetObject(f"pedestrian {index}", body, path, "human.pedestrian.adult", "pedestrian.moving")


def _bystander(
    world: WorldSettings, road: Road, ego: StreetPath, index: int, random: np.random.Generator
) -> StreetObject:
    side = (-1) ** index
    _, place = _encounter(world, ego, index, world.bystanders, random)
    turning, period = random.uniform(0.6, 1.2), random.uniform(5.0, 8.0)
    heading = -side * np.pi / 2
    path = StreetPath(place, side * WALL_SIDE, heading=heading, turning=turning, period=period, road=road)
    body = Person.drawn(random, walks=False)
    return StreetObject(f"bystander {index}", body, path, "human.pedestrian.adult", "pedestrian.standing")


def _cyclist(
    world: WorldSettings, road: Road, ego: StreetPath, index: int, random: np.random.Generator
) -> StreetObject:
    side = (-1) ** (index + 1)
    second, place = _encounter(world, ego, index, world.cyclists, random)
    speed = -side * CYCLING_SPEED
    path = StreetPath(place - speed * second, side * CYCLE_LANE, speed, road=road)
    return StreetObject(f"cyclist {index}", Cyclist.drawn(random), path, "vehicle.bicycle", "cycle.with_rider")


def _dog(index: int, owner: StreetObject, random: np.random.Generator) -> StreetObject:
    walk = owner.path
    path = StreetPath(walk.s + np.sign(walk.speed) * DOG_LEAD, walk.t, walk.speed, road=walk.road)
    return StreetObject(f"dog {index}", Dog.drawn(random), path, "animal", None)
