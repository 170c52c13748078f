"""The shapes of which synthetic worlds are made: meshes, each from a seeded generator, and figures whose limbs move."""

from collections.abc import Callable

import numpy as np

from drivesplat.world.shapes import buildings, mesh, plants, scenery, vehicles
from drivesplat.world.shapes.animals import Dog
from drivesplat.world.shapes.body import Body
from drivesplat.world.shapes.cyclist import Cyclist
from drivesplat.world.shapes.mesh import ColoredMesh, Material, SurfaceClass
from drivesplat.world.shapes.people import Person

RED = (0.5, 0.1, 0.1)
GREY = (0.3, 0.3, 0.3)
BOX = ((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))


def seeded(seed: int = 3) -> np.random.Generator:
    return np.random.default_rng(seed)


VEHICLES: dict[str, tuple[Callable[..., ColoredMesh], tuple[float, float, float]]] = {
    "car": (vehicles.car, (4.5, 1.85, 1.5)),
    "hatchback": (vehicles.hatchback, (4.0, 1.75, 1.5)),
    "estate": (vehicles.estate, (4.7, 1.9, 1.7)),
    "van": (vehicles.van, (5.4, 2.05, 2.5)),
    "short truck": (vehicles.truck, (7.0, 2.4, 3.2)),
    "long truck": (vehicles.truck, (9.0, 2.5, 3.6)),
    "bus": (vehicles.bus, (11.0, 2.55, 3.1)),
}
PLANTS: dict[str, Callable[[np.random.Generator], ColoredMesh]] = {
    "tree": lambda random: plants.tree(7.0, random),
    "tree over the road": lambda random: plants.tree(8.0, random, 2.5),
    "hedge": lambda random: plants.hedge(4.0, 1.2, 0.6, random),
    "planter": plants.planter,
}
FURNITURE: dict[str, tuple[Callable[[], ColoredMesh], set[SurfaceClass]]] = {
    "street lamp": (lambda: scenery.street_lamp(6.5, -1.5), {SurfaceClass.POLE}),
    "sign": (lambda: scenery.sign(RED), {SurfaceClass.POLE, SurfaceClass.SIGN}),
    "street name": (scenery.street_name_sign, {SurfaceClass.POLE, SurfaceClass.SIGN}),
    "cone": (scenery.cone, {SurfaceClass.OBJECT}),
    "fence": (lambda: scenery.fence(6.0), {SurfaceClass.FENCE}),
    "bench": (scenery.bench, {SurfaceClass.OBJECT}),
    "litter bin": (scenery.litter_bin, {SurfaceClass.OBJECT}),
    "mailbox": (scenery.mailbox, {SurfaceClass.OBJECT}),
    "hydrant": (scenery.hydrant, {SurfaceClass.OBJECT}),
    "bollard": (scenery.bollard, {SurfaceClass.POLE}),
    "shelter": (lambda: scenery.bus_shelter(seeded()), {SurfaceClass.OBJECT, SurfaceClass.SIGN, SurfaceClass.POLE}),
    "advertising column": (lambda: scenery.advertising_column(seeded()), {SurfaceClass.OBJECT}),
    "door": (lambda: buildings.front_door(RED), {SurfaceClass.BUILDING}),
    "plain building": (lambda: buildings.building((0, 10, 0), (12, 22, 9), GREY), {SurfaceClass.BUILDING}),
    "building": (lambda: buildings.building((0, 10, 0), (16, 22, 12), GREY, seeded()), {SurfaceClass.BUILDING}),
}
IN_THE_AIR: dict[str, Callable[[], ColoredMesh]] = {
    "awning": lambda: buildings.awning(3.0, RED),
    "balcony": lambda: buildings.balcony(2.5),
    "hanging sign": lambda: buildings.hanging_sign(RED),
    "wire": lambda: scenery.overhead_wire((0.0, 0.0, 8.0), (20.0, 0.0, 8.0)),
}
STANDING: dict[str, Callable[[], ColoredMesh]] = {
    "box": lambda: mesh.box(*BOX, Material.PLAIN, RED),
    "cylinder": lambda: mesh.cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.5, Material.PLAIN, RED),
    "ball": lambda: mesh.ellipsoid((0.0, 0.0, 1.0), (1.0, 0.5, 1.0), Material.PLAIN, RED),
    **{name: (lambda make=make, size=size: make(size, RED)) for name, (make, size) in VEHICLES.items()},
    **{name: make for name, (make, _) in FURNITURE.items()},
}
ALL = {**STANDING, **IN_THE_AIR, **{name: (lambda make=make: make(seeded())) for name, make in PLANTS.items()}}
TOP, TROUSERS = (0.4, 0.06, 0.05), (0.05, 0.06, 0.2)
WALKERS = {
    "walking": Person(1.75, TOP, TROUSERS),
    "short": Person(1.5, TOP, TROUSERS, phase=0.3),
    "tall, with a bag": Person(1.95, TOP, TROUSERS, bag=True),
    "trotting": Dog(0.58),
}
STANDERS = {"standing": Person(1.7, TOP, TROUSERS, bag=True, walks=False), "standing dog": Dog(0.6, walks=False)}
CYCLISTS = {
    "cyclist": Cyclist(1.75, TOP, TROUSERS, TOP, TROUSERS),
    "short cyclist": Cyclist(1.5, TOP, TROUSERS, TOP, TROUSERS, phase=0.2),
    "tall cyclist": Cyclist(1.95, TOP, TROUSERS, TOP, TROUSERS, luggage=False),
}
FIGURES: dict[str, Body] = {**WALKERS, **STANDERS, **CYCLISTS}
