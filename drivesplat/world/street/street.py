"""The street: scenery and objects, placed at random from a seed."""

from dataclasses import dataclass

import numpy as np

from drivesplat.settings.world import WorldSettings
from drivesplat.world.shapes import scenery
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import concatenate
from drivesplat.world.shapes.vehicles import ego_rear, ego_vehicle
from drivesplat.world.street.buildings import rows_of_buildings
from drivesplat.world.street.furniture import LAMPS, furniture, trees
from drivesplat.world.street.ground import ground
from drivesplat.world.street.objects import EGO_BODY, EGO_VEHICLE, StreetObject, fixed
from drivesplat.world.street.paths import ObjectPath, StreetPath
from drivesplat.world.street.people import people
from drivesplat.world.street.road import STRAIGHT, ReferenceLine
from drivesplat.world.street.traffic import ego_path, free_traffic, parked, queue

CONES = np.array([(57.0, -5.0), (59.5, -4.75), (62.0, -4.5)])
BEND_RADIUS = 90.0
"""Metres."""
BEND_START, RISE = 55.0, (15.0, 110.0)
"""Where a bend begins, and where the road begins and ends to rise (metres along the road)."""


@dataclass(frozen=True)
class Street:
    """All `objects`, the positions of `lamps` (m, 3), the `road`, the `ego` path, and the name of the `leading`
    vehicle."""

    objects: tuple[StreetObject, ...]
    lamps: np.ndarray
    road: ReferenceLine
    ego: ObjectPath
    leading: str | None


def build_street(world: WorldSettings) -> Street:
    """The street that the settings describe."""
    random, road = np.random.default_rng(world.random_seed), road_of(world)
    ego = ego_path(world, road)
    static = concatenate(
        [*ground(road), *rows_of_buildings(road, random), *trees(road, random), *furniture(road, random)]
    )
    objects = [fixed("scenery", static), *parked(world, road, CONES, random)]
    for i, (s, t) in enumerate(CONES):
        cone = StreetPath(s, t, road=road)
        objects.append(StreetObject(f"cone {i}", RigidBody(scenery.cone()), cone, "movable_object.trafficcone"))
    traffic = queue if world.traffic == "queue" else free_traffic
    objects += traffic(world, road, random)
    objects += people(world, road, ego, random)
    if world.own_car:
        objects.append(fixed(EGO_VEHICLE, ego_rear(), ego))
    if world.lidar.ego_returns:
        objects.append(fixed(EGO_BODY, ego_vehicle(), ego))
    lamps = road.points(np.column_stack([LAMPS - np.sign(LAMPS) * [0.0, 1.5], np.full(len(LAMPS), 6.6)]))
    leading = next((item.name for item in objects if item.name == "vehicle 0"), None)
    return Street(tuple(sorted(objects, key=lambda item: item.moves)), lamps, road, ego, leading)


def road_of(world: WorldSettings) -> ReferenceLine:
    """The course of the road."""
    if not world.bend_deg and not world.grade:
        return STRAIGHT
    angle = np.radians(world.bend_deg)
    radius = np.copysign(BEND_RADIUS, angle) if angle else np.inf
    return ReferenceLine(BEND_START, BEND_RADIUS * abs(angle), radius, world.grade, *RISE)
