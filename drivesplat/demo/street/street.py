"""The street: scenery, parked and moving objects, placed at random from a seed."""

from dataclasses import dataclass

import numpy as np

from drivesplat.demo import meshes
from drivesplat.demo.materials import CURB, LANE, ROAD, SIDEWALK, WINDOW
from drivesplat.demo.meshes import Color, ColoredMesh, Material
from drivesplat.demo.traffic import StreetPath, ego_path, pedestrian_paths, vehicle_paths
from drivesplat.settings.world import WorldSettings

X_RANGE = (-80.0, 260.0)
"""First and last x (metres along the road) of the buildings."""
EGO_VEHICLE = "ego vehicle"
CONES = ((57.0, -4.6), (59.5, -4.3), (62.0, -4.0))
PAINTS: tuple[Color, ...] = (
    (0.5, 0.5, 0.52), (0.55, 0.06, 0.05), (0.05, 0.12, 0.35), (0.03, 0.03, 0.04), (0.7, 0.7, 0.68), (0.08, 0.22, 0.14),
    (0.6, 0.4, 0.05),
)  # fmt: skip
WALLS: tuple[Color, ...] = (
    (0.34, 0.17, 0.11), (0.45, 0.38, 0.27), (0.28, 0.29, 0.31), (0.42, 0.3, 0.22), (0.24, 0.25, 0.2)
)  # fmt: skip


@dataclass(frozen=True)
class StreetObject:
    """An object on the street: its mesh in its own frame and its path. nuScenes' `category` is None for scenery; where
    it `walks` the mesh follows the stride."""

    name: str
    mesh: ColoredMesh
    path: StreetPath
    category: str | None = None
    attribute: str | None = None
    walks: bool = False

    @property
    def moves(self) -> bool:
        return self.path.speed != 0.0

    def mesh_at(self, seconds: float) -> ColoredMesh:
        """The mesh at a time."""
        return walker_mesh(self.name, float(np.sin(2 * np.pi * 0.9 * seconds))) if self.walks else self.mesh


@dataclass(frozen=True)
class Street:
    """All `objects`, the positions of `lamps` (m, 3), the `ego` path, and the name of the `leading` vehicle."""

    objects: tuple[StreetObject, ...]
    lamps: np.ndarray
    ego: StreetPath
    leading: str | None


def build_street(world: WorldSettings) -> Street:
    """The street that the settings describe."""
    random = np.random.default_rng(world.random_seed)
    ego_drives = world.ego == "drives"
    poles = np.array([(x, 6.5 * (-1) ** i) for i, x in enumerate(range(-30, 200, 24))], dtype=float)
    scenery = meshes.concatenate([*_ground(), *_buildings(random), *_trees(random), *_furniture(poles, random)])
    objects = [StreetObject("scenery", scenery, StreetPath(0.0, 0.0)), *_parked(world.parked, random)]
    for i, (x, y) in enumerate(CONES):
        objects.append(StreetObject(f"cone {i}", meshes.cone(), StreetPath(x, y), "movable_object.trafficcone"))
    for i, path in enumerate(vehicle_paths(world.vehicles, ego_drives)):
        mesh, category = _vehicle_mesh(i % 3 == 2, random)
        objects.append(StreetObject(f"vehicle {i}", mesh, path, category, "vehicle.moving"))
    for i, path in enumerate(pedestrian_paths(world.pedestrians, random)):
        name, kind = f"pedestrian {i}", ("human.pedestrian.adult", "pedestrian.moving")
        objects.append(StreetObject(name, walker_mesh(name, 1.0), path, *kind, walks=True))
    if world.own_car:
        objects.append(StreetObject(EGO_VEHICLE, meshes.ego_rear(), ego_path(ego_drives)))
    lamps = np.column_stack([poles - np.sign(poles) * [0.0, 1.5], np.full(len(poles), 6.6)])
    return Street(tuple(objects), lamps, ego_path(ego_drives), "vehicle 0" if world.vehicles else None)


def walker_mesh(name: str, stride: float) -> ColoredMesh:
    """A pedestrian with `stride` in [-1, 1]. The name determines height and clothes."""
    random = np.random.default_rng(sum(map(ord, name)))
    shirt, trousers = random.uniform(0.05, 0.6, 3), random.uniform(0.02, 0.2, 3)
    return meshes.pedestrian(random.uniform(1.62, 1.85), tuple(shirt), tuple(trousers), stride)


def _ground() -> list[ColoredMesh]:
    plane = meshes.box((-600, -600, -0.05), (900, 600, 0.0), Material.ROAD, (0.1, 0.1, 0.1))
    curbs = [
        meshes.box((X_RANGE[0], side * ROAD, -0.02), (X_RANGE[1], side * CURB, 0.1), Material.ROAD, (0.3, 0.3, 0.3))
        for side in (-1, 1)
    ]
    return [plane, *curbs]


def _buildings(random: np.random.Generator) -> list[ColoredMesh]:
    """Rows of buildings on both sides, and some across both ends."""
    buildings = []
    for side in (-1, 1):
        x = X_RANGE[0]
        while x < X_RANGE[1]:
            width, gap = WINDOW[0] * random.integers(4, 9), WINDOW[0] * random.integers(0, 3)
            near = side * (SIDEWALK + 0.5 + random.uniform(0, 2.5))
            low, high = sorted((near, near + side * 12.0))
            top = WINDOW[1] * random.integers(2, 7)
            buildings.append(meshes.building((x, low, 0.0), (x + width, high, top), WALLS[random.integers(len(WALLS))]))
            x += width + gap
    for i, y in enumerate((-48.0, -16.0, 12.8, 41.6)):
        top = WINDOW[1] * (5 + 2 * i % 5)
        buildings.append(meshes.building((X_RANGE[1] + 20, y, 0), (X_RANGE[1] + 35, y + 25.6, top), WALLS[i]))
        buildings.append(meshes.building((X_RANGE[0] - 45, y, 0), (X_RANGE[0] - 30, y + 25.6, top), WALLS[i]))
    return buildings


def _trees(random: np.random.Generator) -> list[ColoredMesh]:
    trees = []
    for side in (-1, 1):
        for x in np.arange(X_RANGE[0] + 6 * side, 190.0, 17.0):
            position = (x + random.uniform(-2, 2), side * random.uniform(7.75, 8.6), 0.0)
            trees.append(meshes.tree(random.uniform(5.0, 8.0), random).moved(position))
    return trees


def _furniture(poles: np.ndarray, random: np.random.Generator) -> list[ColoredMesh]:
    lamps = [meshes.street_lamp(6.5, -np.sign(y) * 1.5).moved((x, y, 0.0)) for x, y in poles]
    signs = [
        meshes.sign(color).moved((x + random.uniform(-3, 3), -6.5, 0.0))
        for x, color in ((28.0, (0.6, 0.04, 0.03)), (44.5, (0.04, 0.1, 0.5)), (90.0, (0.6, 0.04, 0.03)))
    ]
    bins = [
        meshes.cylinder((x, side * 6.4, 0), (x, side * 6.4, 0.95), 0.28, Material.PLAIN, (0.05, 0.12, 0.06))
        for x, side in ((17.0, 1), (52.0, -1), (81.0, 1), (110.0, -1))
    ]
    return [*lamps, *signs, *bins]


def _parked(count: int, random: np.random.Generator) -> list[StreetObject]:
    """Parked vehicles on both sides, away from the crossing and the cones; every fifth is a van."""
    free = [(x, side) for x in np.arange(4.0, 130.0, 7.2) for side in (-1, 1) if not 40.0 < x < 54.0]
    objects = []
    drawn = [free[index] for index in random.permutation(len(free))]
    clear = [(x, side) for x, side in drawn if side > 0 or all(abs(x - cone) > 5.0 for cone, _ in CONES)]
    for i, (x, side) in enumerate(clear[:count]):
        mesh, category = _vehicle_mesh(i % 5 == 4, random)
        heading = 0.0 if side < 0 else np.pi
        y = side * ((LANE + ROAD) / 2 + random.uniform(-0.1, 0.1))
        objects.append(StreetObject(f"parked {i}", mesh, StreetPath(x, y, heading=heading), category, "vehicle.parked"))
    return objects


def _vehicle_mesh(is_van: bool, random: np.random.Generator) -> tuple[ColoredMesh, str]:
    color = PAINTS[random.integers(len(PAINTS))]
    if is_van:
        return meshes.van((5.4, 2.05, 2.5), (0.7, 0.7, 0.68)), "vehicle.truck"
    size = (random.uniform(4.2, 4.8), random.uniform(1.78, 1.9), random.uniform(1.45, 1.6))
    return meshes.car(size, color), "vehicle.car"
