"""Trees, lamps, signs and other furniture of the sidewalks."""

from collections.abc import Callable

import numpy as np

from drivesplat.world.layout import FURNITURE, TREES
from drivesplat.world.shapes import plants, scenery
from drivesplat.world.shapes.mesh import ColoredMesh
from drivesplat.world.street.buildings import ALONG
from drivesplat.world.street.road import ReferenceLine

LAMP_HEIGHT, LAMP_ARM = 6.5, 1.5
"""Metres."""
SIGNS = ((28.0, (0.6, 0.04, 0.03)), (44.5, (0.04, 0.1, 0.5)), (90.0, (0.6, 0.04, 0.03)))
"""Place along the road in metres and colour of each sign."""
TREE_SPACING = 17.0
SHELTER = 104.0
"""Place along the road of the bus shelter, on the right."""
KERBSIDE: tuple[Callable[[], ColoredMesh], ...] = (
    scenery.litter_bin, scenery.hydrant, scenery.mailbox, scenery.bollard, scenery.street_name_sign,
)  # fmt: skip
"""Small things beside the curb."""
LAMPS = np.array([(s, FURNITURE * (-1) ** i) for i, s in enumerate(range(-30, 200, 24))], dtype=float)
"""Places s, t (m, 2) of the street lamps, alternately on both sides."""


def trees(road: ReferenceLine, random: np.random.Generator) -> list[ColoredMesh]:
    """A row of trees on each sidewalk, some of which overhang the road; between them benches, planters and advertising
    columns."""
    found = []
    for side in (-1, 1):
        for s in np.arange(ALONG[0] + 6 * side, 190.0, TREE_SPACING):
            place = s + random.uniform(-2, 2), side * random.uniform(*TREES)
            overhang = -side * random.uniform(1.5, 2.5) if random.uniform() < 0.4 else 0.0
            tree = plants.tree(random.uniform(5.0, 8.0), random, overhang)
            if side > 0 or abs(place[0] - SHELTER) > 4.0:
                found.append(road.place(tree, *place))
            between = s + TREE_SPACING / 2
            if side > 0 or abs(between - SHELTER) > 4.0:
                kind = random.integers(4)
                if kind < 2:
                    item = scenery.advertising_column(random) if kind == 0 else plants.planter(random)
                else:
                    item = scenery.bench().moved((0.0, 0.0, 0.0), 0.0 if side < 0 else np.pi)
                found.append(road.place(item, between, side * 8.9))
    return found


def furniture(road: ReferenceLine, random: np.random.Generator) -> list[ColoredMesh]:
    """Street lamps with wires between some of them, signs, a bus shelter, and small things beside the curb, clear of
    the pedestrians' path."""
    found = [road.place(scenery.street_lamp(LAMP_HEIGHT, -np.sign(t) * LAMP_ARM), s, t) for s, t in LAMPS]
    found += [road.place(scenery.sign(color), s + random.uniform(-3, 3), -FURNITURE) for s, color in SIGNS]
    tops = road.points(np.column_stack([LAMPS, np.full(len(LAMPS), LAMP_HEIGHT - 0.2)]))
    found += [scenery.overhead_wire(tops[i], tops[i + 1]) for i in range(1, len(tops) - 1, 3)]
    found.append(road.place(scenery.bus_shelter(random), SHELTER, -9.0))
    for i, s in enumerate(np.arange(-20.0, 140.0, 11.0)):
        side = (-1) ** i
        if np.abs(LAMPS[:, 0] - s).min() > 1.0:
            found.append(road.place(KERBSIDE[i % len(KERBSIDE)](), s, side * FURNITURE))
    return found
