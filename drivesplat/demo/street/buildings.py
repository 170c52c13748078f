"""Rows of buildings along the street."""

import numpy as np

from drivesplat.demo.shapes.mesh import Color, ColoredMesh
from drivesplat.demo.shapes.scenery import building
from drivesplat.demo.street.layout import SIDEWALK, WINDOW
from drivesplat.demo.street.road import Road

ALONG = (-80.0, 260.0)
"""First and last s (metres) of the buildings."""
FOUNDATION = 3.0
"""Metres by which walls reach below the ground, for slopes."""
WALLS: tuple[Color, ...] = (
    (0.34, 0.17, 0.11), (0.45, 0.38, 0.27), (0.28, 0.29, 0.31), (0.42, 0.3, 0.22), (0.24, 0.25, 0.2)
)  # fmt: skip


def rows_of_buildings(road: Road, random: np.random.Generator) -> list[ColoredMesh]:
    """Buildings on both sides, and some across both ends."""
    buildings = []
    for side in (-1, 1):
        s = ALONG[0]
        while s < ALONG[1]:
            width, gap = WINDOW[0] * random.integers(4, 9), WINDOW[0] * random.integers(0, 3)
            near = side * (SIDEWALK + 0.5 + random.uniform(0, 2.5))
            low, high = sorted((near, near + side * 12.0))
            top = WINDOW[1] * random.integers(2, 7)
            mesh = _building((-width / 2, low, 0.0), (width / 2, high, top), WALLS[random.integers(len(WALLS))])
            buildings.append(road.place(mesh, s + width / 2))
            s += width + gap
    for i, t in enumerate((-48.0, -16.0, 12.8, 41.6)):
        top = WINDOW[1] * (5 + 2 * i % 5)
        buildings.append(road.place(_building((0.0, t, 0.0), (15.0, t + 25.6, top), WALLS[i]), ALONG[1] + 20))
        buildings.append(road.place(_building((0.0, t, 0.0), (15.0, t + 25.6, top), WALLS[i]), ALONG[0] - 45))
    return buildings


def _building(low: tuple, high: tuple, color: Color) -> ColoredMesh:
    return building((low[0], low[1], -FOUNDATION), high, color)
