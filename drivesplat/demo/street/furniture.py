"""Trees, lamps, signs and bins beside the road."""

import numpy as np

from drivesplat.demo.shapes import scenery
from drivesplat.demo.shapes.mesh import ColoredMesh
from drivesplat.demo.street.buildings import ALONG
from drivesplat.demo.street.layout import FURNITURE, TREES
from drivesplat.demo.street.road import Road

SIGNS = ((28.0, (0.6, 0.04, 0.03)), (44.5, (0.04, 0.1, 0.5)), (90.0, (0.6, 0.04, 0.03)))
"""Place along the road in metres and colour of each sign."""


def lamp_places() -> np.ndarray:
    """Places s, t (m, 2) of the street lamps, alternately on both sides."""
    return np.array([(s, FURNITURE * (-1) ** i) for i, s in enumerate(range(-30, 200, 24))], dtype=float)


def trees(road: Road, random: np.random.Generator) -> list[ColoredMesh]:
    """A row of trees on each sidewalk."""
    found = []
    for side in (-1, 1):
        for s in np.arange(ALONG[0] + 6 * side, 190.0, 17.0):
            place = s + random.uniform(-2, 2), side * random.uniform(*TREES)
            found.append(road.place(scenery.tree(random.uniform(5.0, 8.0), random), *place))
    return found


def furniture(road: Road, lamps: np.ndarray, random: np.random.Generator) -> list[ColoredMesh]:
    """Street lamps at the places `lamps` (m, 2), signs and bins."""
    found = [road.place(scenery.street_lamp(6.5, -np.sign(t) * 1.5), s, t) for s, t in lamps]
    found += [road.place(scenery.sign(color), s + random.uniform(-3, 3), -FURNITURE) for s, color in SIGNS]
    found += [
        road.place(scenery.litter_bin(), s, side * FURNITURE)
        for s, side in ((17.0, 1), (52.0, -1), (81.0, 1), (110.0, -1))
    ]
    return found
