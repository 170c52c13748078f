"""The street: scenery, vehicles and other objects, placed at random from a seed."""

from dataclasses import dataclass, replace

import numpy as np

from drivesplat.settings.world import WorldSettings
from drivesplat.world.layout import CROSSING, PARKING
from drivesplat.world.shapes import scenery
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import concatenate
from drivesplat.world.shapes.vehicles import ego_rear, ego_vehicle, vehicle
from drivesplat.world.street.objects import EGO_BODY, EGO_VEHICLE, StreetObject, fixed
from drivesplat.world.street.paths import LANE_CENTER, ObjectPath, StreetPath
from drivesplat.world.street.people import people
from drivesplat.world.street.road import STRAIGHT, ReferenceLine
from drivesplat.world.street.roadside import LAMPS, furniture, ground, rows_of_buildings, trees

CONES = np.array([(57.0, -5.0), (59.5, -4.75), (62.0, -4.5)])
BEND_RADIUS = 90.0
"""Metres."""
BEND_START, RISE = 55.0, (15.0, 110.0)
"""Where a bend begins, and where the road begins and ends to rise (metres along the road)."""
EGO_REACH = (-0.7, 3.5)
"""Rear and front end of the ego vehicle in metres from its origin, the centre of its rear axle."""
PARKED_SPACING = 7.2
CREEP = 1.1
"""Mean speed of a queue in m/s."""
QUEUE_AHEAD = (("truck", 3.6), ("car", 5.0), ("van", 5.5), ("car", 6.0))
"""Kind of each vehicle ahead of the ego vehicle in a queue, and the gap in metres before it."""
QUEUE_ONCOMING = ("car", "truck", "car", "van", "car", "car", "truck", "car")
ONCOMING_GAP, ONCOMING_APPROACH = 2.2, 1.7
"""Gap between oncoming vehicles of a queue, and how far one drives up to the standing one before it (metres)."""


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
    if not world.bend_deg and not world.grade:
        return STRAIGHT
    angle = np.radians(world.bend_deg)
    radius = np.copysign(BEND_RADIUS, angle) if angle else np.inf
    return ReferenceLine(BEND_START, BEND_RADIUS * abs(angle), radius, world.grade, *RISE)


def ego_path(world: WorldSettings, road: ReferenceLine) -> StreetPath:
    if world.ego == "stands":
        return StreetPath(12.0, -LANE_CENTER, road=road)
    if world.traffic == "queue":
        return StreetPath(12.0, -LANE_CENTER, CREEP, 0.9 * CREEP, 0.05, 6.0, suspension=True, road=road)
    return StreetPath(0.0, -LANE_CENTER, 8.0, 0.6, 0.12, 9.0, suspension=True, road=road)


def free_traffic(world: WorldSettings, road: ReferenceLine, random: np.random.Generator) -> list[StreetObject]:
    """`world.vehicles` vehicles: the first drives ahead of the ego vehicle; oncoming ones and further ones ahead follow
    alternately."""
    drives = world.ego == "drives"
    starts = ((13.0, 8.6), (42.0, 9.2), (70.0, 9.0)) if drives else ((24.0, 4.0), (48.0, 6.0), (76.0, 6.5))
    paths = []
    for i, (s, speed) in enumerate(starts):
        paths.append(StreetPath(s, -LANE_CENTER, speed, 1.2, 0.1, 7.0 + i, road=road))
        paths.append(StreetPath(96.0 + 42.0 * i, LANE_CENTER, -(9.0 + 0.7 * i), 0.7, 0.1, 8.0, road=road))
    kinds = ("van" if i % 3 == 2 else "car" for i in range(world.vehicles))
    return [
        _vehicle(f"vehicle {i}", kind, path, random) for i, (kind, path) in enumerate(zip(kinds, paths, strict=False))
    ]


def queue(world: WorldSettings, road: ReferenceLine, random: np.random.Generator) -> list[StreetObject]:
    """Vehicles at close range in both lanes. Those ahead creep as the ego vehicle does; every third oncoming one
    stands."""
    ego = ego_path(world, road)
    objects, front = [], ego.s + EGO_REACH[1]
    for i, (kind, gap) in enumerate(QUEUE_AHEAD):
        path = StreetPath(0.0, -LANE_CENTER, CREEP, 0.9 * CREEP, 0.03, 6.0 + 0.5 * i, road=road)
        objects.append(_queued(f"vehicle {i}", kind, path, front + gap, random))
        front += gap + objects[-1].size[0]
    near, creep = ego.s + 2.0, min(0.25, ONCOMING_APPROACH / world.seconds)
    for i, kind in enumerate(QUEUE_ONCOMING):
        standing = i % 3 == 0
        speed, surge = (0.0, 0.0) if standing else (-creep, 0.8 * creep)
        path = StreetPath(0.0, LANE_CENTER, speed, surge, 0.0, 5.0 + i, heading=np.pi, road=road)
        objects.append(_queued(f"oncoming {i}", kind, path, near, random))
        near += ONCOMING_GAP + objects[-1].size[0]
    return objects


def parked(
    world: WorldSettings, road: ReferenceLine, cones: np.ndarray, random: np.random.Generator
) -> list[StreetObject]:
    """Parked vehicles on both sides, away from the crossing and the `cones` (n, 2); every fifth is a van."""
    places = np.arange(4.0, 130.0, PARKED_SPACING)
    free = [(s, side) for s in places for side in (-1, 1) if not CROSSING[0] - 6.0 < s < CROSSING[1] + 5.0]
    drawn = [free[index] for index in random.permutation(len(free))]
    clear = [(s, side) for s, side in drawn if side > 0 or np.abs(cones[:, 0] - s).min() > 5.0]
    objects = []
    for i, (s, side) in enumerate(clear[: world.parked]):
        t = side * (PARKING + random.uniform(-0.1, 0.1))
        path = StreetPath(s, t, heading=0.0 if side < 0 else np.pi, road=road)
        objects.append(_vehicle(f"parked {i}", "van" if i % 5 == 4 else "car", path, random, "vehicle.parked"))
    return objects


def _vehicle(
    name: str, kind: str, path: StreetPath, random: np.random.Generator, attribute: str = "vehicle.moving"
) -> StreetObject:
    mesh, category = vehicle(kind, random)
    return StreetObject(name, RigidBody(mesh), path, category, attribute)


def _queued(name: str, kind: str, path: StreetPath, rear: float, random: np.random.Generator) -> StreetObject:
    """A vehicle whose nearest end is at s = `rear`."""
    mesh, category = vehicle(kind, random)
    placed = replace(path, s=rear + mesh.size[0] / 2)
    attribute = "vehicle.moving" if path.speed else "vehicle.stopped"
    return StreetObject(name, RigidBody(mesh), placed, category, attribute)
