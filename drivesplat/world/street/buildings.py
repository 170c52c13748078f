"""Rows of buildings along the street, with hedges and fences between them."""

import numpy as np

from drivesplat.world.layout import SIDEWALK, WINDOW
from drivesplat.world.shapes.buildings import building
from drivesplat.world.shapes.mesh import Color, ColoredMesh, Material, SurfaceClass, box, concatenate
from drivesplat.world.shapes.plants import hedge
from drivesplat.world.shapes.scenery import fence
from drivesplat.world.street.road import ReferenceLine

ALONG = (-80.0, 260.0)
"""First and last s (metres) of the buildings."""
FOUNDATION = 3.0
"""Metres by which walls reach below the ground, for slopes."""
FORECOURT = 1.1
"""Least distance (metres) of a building from the sidewalk; what protrudes from its wall is within it."""
DEPTH = 12.0
WALLS: tuple[Color, ...] = (
    (0.34, 0.17, 0.11), (0.45, 0.38, 0.27), (0.28, 0.29, 0.31), (0.42, 0.3, 0.22), (0.24, 0.25, 0.2)
)  # fmt: skip


def rows_of_buildings(road: ReferenceLine, random: np.random.Generator) -> list[ColoredMesh]:
    """Buildings on both sides, hedges and fences across the gaps between them, and buildings across both ends."""
    found = []
    for side in (-1, 1):
        s = ALONG[0]
        while s < ALONG[1]:
            width, gap = WINDOW[0] * random.integers(4, 9), WINDOW[0] * random.integers(0, 3)
            near = side * (SIDEWALK + FORECOURT + random.uniform(0, 2.0))
            low, high = sorted((near, near + side * DEPTH))
            top, color = WINDOW[1] * random.integers(2, 7), WALLS[random.integers(len(WALLS))]
            found.append(
                road.place(standing_building((-width / 2, low), (width / 2, high), top, color, random), s + width / 2)
            )
            if gap:
                barrier = hedge(gap, 1.1, 0.6, random) if random.uniform() < 0.6 else fence(gap)
                found.append(road.place(barrier, s + width + gap / 2, side * (SIDEWALK + 0.6)))
            s += width + gap
    for i, t in enumerate((-48.0, -16.0, 12.8, 41.6)):
        across = standing_building((0.0, t), (15.0, t + 25.6), WINDOW[1] * (5 + 2 * i % 5), WALLS[i])
        found += [road.place(across, ALONG[1] + 20), road.place(across, ALONG[0] - 45)]
    return found


def standing_building(
    low: tuple[float, float], high: tuple[float, float], top: float, color: Color,
    random: np.random.Generator | None = None,
) -> ColoredMesh:  # fmt: skip
    """A building on a foundation, between two corners on the ground."""
    base = box((*low, -FOUNDATION), (*high, 0.0), Material.PLAIN, color).classified(SurfaceClass.BUILDING)
    return concatenate([base, building((*low, 0.0), (*high, top), color, random)])
