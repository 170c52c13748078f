"""The street: what stands and who moves on it, placed at random from a seed."""

from dataclasses import dataclass

import numpy as np

from drivesplat.demo import bodies
from drivesplat.demo.bodies import Body, Color, Material
from drivesplat.demo.materials import CURB, LANE, ROAD, SIDEWALK, WINDOW
from drivesplat.demo.traffic import StreetMotion, ego_motion, pedestrian_motions, vehicle_motions
from drivesplat.settings.world import WorldSettings

LENGTH = (-80.0, 260.0)
"""From where to where (metres along the road) the street is built up."""
OWN_CAR = "own car"
CONES = ((57.0, -4.6), (59.5, -4.3), (62.0, -4.0))
PAINTS: tuple[Color, ...] = (
    (0.5, 0.5, 0.52), (0.55, 0.06, 0.05), (0.05, 0.12, 0.35), (0.03, 0.03, 0.04), (0.7, 0.7, 0.68), (0.08, 0.22, 0.14),
    (0.6, 0.4, 0.05),
)  # fmt: skip
WALLS: tuple[Color, ...] = (
    (0.34, 0.17, 0.11),
    (0.45, 0.38, 0.27),
    (0.28, 0.29, 0.31),
    (0.42, 0.3, 0.22),
    (0.24, 0.25, 0.2),
)


@dataclass(frozen=True)
class Thing:
    """Something on the street: its shape in its own frame, where it is, and what nuScenes calls it.

    `category` None: scenery. `walks`: its legs swing.
    """

    name: str
    body: Body
    motion: StreetMotion
    category: str | None = None
    attribute: str | None = None
    walks: bool = False

    @property
    def moves(self) -> bool:
        return self.motion.speed != 0.0

    def body_at(self, seconds: float) -> Body:
        """Its shape at a time."""
        if not self.walks:
            return self.body
        return walker(self.name, float(np.sin(2 * np.pi * 0.9 * seconds)))


@dataclass(frozen=True)
class Street:
    """`things` on it, the `lamps` (m, 3) above it, how the own car goes along it; `leading` names the car ahead."""

    things: tuple[Thing, ...]
    lamps: np.ndarray
    ego: StreetMotion
    leading: str | None


def build_street(world: WorldSettings) -> Street:
    """The street that the settings describe."""
    random = np.random.default_rng(world.random_seed)
    lamp_places = np.array([(x, 6.5 * (-1) ** i) for i, x in enumerate(range(-30, 200, 24))], dtype=float)
    scenery = bodies.joined([*_ground(), *_houses(random), *_trees(random), *_furniture(lamp_places, random)])
    things = [Thing("scenery", scenery, StreetMotion(0.0, 0.0)), *_parked(world.parked, random), *_cones()]
    vehicles = _vehicles(vehicle_motions(world.vehicles, world.ego == "drives"), random)
    walkers = _walkers(pedestrian_motions(world.pedestrians, random))
    lamps = np.column_stack([lamp_places - np.sign(lamp_places) * [0.0, 1.5], np.full(len(lamp_places), 6.6)])
    leading, ego = vehicles[0].name if vehicles else None, ego_motion(world.ego == "drives")
    ego_vehicle = [Thing(OWN_CAR, bodies.tail(), ego)] if world.own_car else []
    return Street((*things, *vehicles, *walkers, *ego_vehicle), lamps, ego, leading)


def _walkers(motions: list[StreetMotion]) -> list[Thing]:
    names = [f"pedestrian {i}" for i in range(len(motions))]
    kind = ("human.pedestrian.adult", "pedestrian.moving")
    return [Thing(n, walker(n, 1.0), motion, *kind, walks=True) for n, motion in zip(names, motions, strict=True)]


def walker(name: str, stride: float) -> Body:
    """The body of a pedestrian in mid-stride; looks go with the name."""
    random = np.random.default_rng(sum(map(ord, name)))
    shirt, trousers = random.uniform(0.05, 0.6, 3), random.uniform(0.02, 0.2, 3)
    return bodies.pedestrian(random.uniform(1.62, 1.85), tuple(shirt), tuple(trousers), stride)


def _ground() -> list[Body]:
    plane = bodies.box((-600, -600, -0.05), (900, 600, 0.0), Material.ROAD, (0.1, 0.1, 0.1))
    curbs = [
        bodies.box((LENGTH[0], side * ROAD, -0.02), (LENGTH[1], side * CURB, 0.1), Material.ROAD, (0.3, 0.3, 0.3))
        for side in (-1, 1)
    ]
    return [plane, *curbs]


def _houses(random: np.random.Generator) -> list[Body]:
    """Rows of houses on both sides, and some that close the view."""
    houses = []
    for side in (-1, 1):
        x = LENGTH[0]
        while x < LENGTH[1]:
            width, gap = WINDOW[0] * random.integers(4, 9), WINDOW[0] * random.integers(0, 3)
            near = side * (SIDEWALK + 0.5 + random.uniform(0, 2.5))
            low, high = sorted((near, near + side * 12.0))
            top = WINDOW[1] * random.integers(2, 7)
            houses.append(bodies.building((x, low, 0.0), (x + width, high, top), WALLS[random.integers(len(WALLS))]))
            x += width + gap
    for i, y in enumerate((-48.0, -16.0, 12.8, 41.6)):
        top = WINDOW[1] * (5 + 2 * i % 5)
        houses.append(bodies.building((LENGTH[1] + 20, y, 0), (LENGTH[1] + 35, y + 25.6, top), WALLS[i]))
        houses.append(bodies.building((LENGTH[0] - 45, y, 0), (LENGTH[0] - 30, y + 25.6, top), WALLS[i]))
    return houses


def _trees(random: np.random.Generator) -> list[Body]:
    trees = []
    for side in (-1, 1):
        for x in np.arange(LENGTH[0] + 6 * side, 190.0, 17.0):
            place = (x + random.uniform(-2, 2), side * random.uniform(7.75, 8.6), 0.0)
            trees.append(bodies.tree(random.uniform(5.0, 8.0), random).moved(place))
    return trees


def _furniture(lamp_places: np.ndarray, random: np.random.Generator) -> list[Body]:
    lamps = [bodies.street_lamp(6.5, -np.sign(y) * 1.5).moved((x, y, 0.0)) for x, y in lamp_places]
    signs = [
        bodies.sign(color).moved((x + random.uniform(-3, 3), -6.5, 0.0))
        for x, color in ((28.0, (0.6, 0.04, 0.03)), (44.5, (0.04, 0.1, 0.5)), (90.0, (0.6, 0.04, 0.03)))
    ]
    bins = [
        bodies.cylinder((x, side * 6.4, 0), (x, side * 6.4, 0.95), 0.28, Material.PLAIN, (0.05, 0.12, 0.06))
        for x, side in ((17.0, 1), (52.0, -1), (81.0, 1), (110.0, -1))
    ]
    return [*lamps, *signs, *bins]


def _parked(count: int, random: np.random.Generator) -> list[Thing]:
    """Parked vehicles on both sides, clear of the crossing and of the cones; every fifth is a van."""
    free = [(x, side) for x in np.arange(4.0, 130.0, 7.2) for side in (-1, 1) if not 40.0 < x < 54.0]
    things = []
    drawn = [free[index] for index in random.permutation(len(free))]
    clear = [(x, side) for x, side in drawn if side > 0 or all(abs(x - cone) > 5.0 for cone, _ in CONES)]
    for i, (x, side) in enumerate(clear[:count]):
        body, category = _vehicle_body(i % 5 == 4, random)
        facing = 0.0 if side < 0 else np.pi
        y = side * ((LANE + ROAD) / 2 + random.uniform(-0.1, 0.1))
        things.append(Thing(f"parked {i}", body, StreetMotion(x, y, heading=facing), category, "vehicle.parked"))
    return things


def _vehicle_body(is_van: bool, random: np.random.Generator) -> tuple[Body, str]:
    color = PAINTS[random.integers(len(PAINTS))]
    if is_van:
        return bodies.van((5.4, 2.05, 2.5), (0.7, 0.7, 0.68)), "vehicle.truck"
    size = (random.uniform(4.2, 4.8), random.uniform(1.78, 1.9), random.uniform(1.45, 1.6))
    return bodies.car(size, color), "vehicle.car"


def _vehicles(motions: list[StreetMotion], random: np.random.Generator) -> list[Thing]:
    things = []
    for i, motion in enumerate(motions):
        body, category = _vehicle_body(i % 3 == 2, random)
        things.append(Thing(f"vehicle {i}", body, motion, category, "vehicle.moving"))
    return things


def _cones() -> list[Thing]:
    return [
        Thing(f"cone {i}", bodies.cone(), StreetMotion(x, y), "movable_object.trafficcone")
        for i, (x, y) in enumerate(CONES)
    ]
