"""The static street: road, curbs and grass as strips along it, rows of buildings with hedges and fences between them,
trees, lamps, signs and other furniture of the sidewalks."""

from collections.abc import Callable

import numpy as np

from drivesplat.world.layout import CURB, FURNITURE, ROAD, SIDEWALK, TREES, WINDOW
from drivesplat.world.shapes import plants, scenery
from drivesplat.world.shapes.buildings import building
from drivesplat.world.shapes.mesh import Color, ColoredMesh, Material, SurfaceClass, box, concatenate
from drivesplat.world.shapes.plants import hedge
from drivesplat.world.shapes.scenery import fence
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
NEAR = (-120.0, 300.0)
"""First and last s (metres) of the street proper."""
FAR = 600.0
"""Metres to which the ground extends."""
CELL = 3.0
"""Length of a cell of the ground (metres) where the road is not straight; without that, 30."""
CURB_HEIGHT = 0.1


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


def ground(road: ReferenceLine) -> list[ColoredMesh]:
    """The strips of the ground and the two curbs."""
    # within the bend's centre no strip may reach: there s, t would be ambiguous
    inner = np.inf if road.is_straight else 0.8 * abs(road.radius)
    aside = min(FAR, inner)
    strips = [
        _strip(road, -ROAD, ROAD, SurfaceClass.ROAD),
        *(_strip(road, *sorted((side * ROAD, side * SIDEWALK)), SurfaceClass.SIDEWALK) for side in (-1, 1)),
        *(_strip(road, *sorted((side * SIDEWALK, side * aside)), SurfaceClass.TERRAIN) for side in (-1, 1)),
    ]
    cell = 30.0 if road.is_straight else CELL
    along = np.arange(NEAR[0], NEAR[1] + cell, cell)
    first = (np.arange(len(along) - 1)[:, None] * 4 + np.arange(3)).ravel()
    corners = np.stack([first, first + 4, first + 5, first + 1], axis=-1)
    faces = np.concatenate([corners[:, [0, 2, 1]], corners[:, [0, 3, 2]]])
    for side in (-1, 1):  # the kerb stones beside the road, which stand out of it
        low, high = sorted((side * ROAD, side * CURB))
        profile = np.array([(low, -0.02), (low, CURB_HEIGHT), (high, CURB_HEIGHT), (high, -0.02)])
        points = np.array([(s, t, h) for s in along for t, h in profile])
        strips.append(road.follow(_mesh(points, faces, SurfaceClass.SIDEWALK)))
    return strips


def _strip(road: ReferenceLine, right: float, left: float, surface_class: SurfaceClass) -> ColoredMesh:
    """The ground between two offsets from the centre line."""
    cell = 30.0 if road.is_straight else CELL
    near = np.arange(NEAR[0], NEAR[1] + cell, cell)
    along = np.concatenate([[-FAR], near, [near[-1] + FAR]])
    across = np.unique(np.concatenate([[right, left], np.arange(np.ceil(right / 8) * 8, left, 8.0)]))
    across = across[(np.abs(across) <= 40.0) | (across == right) | (across == left)]
    s, t = np.meshgrid(along, across, indexing="ij")
    flat = np.stack([s, t, np.zeros_like(s)], axis=-1).reshape(-1, 3)
    rows, columns = len(along), len(across)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corners = np.stack([first, first + columns, first + columns + 1, first + 1], axis=-1)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return road.follow(_mesh(flat, faces, surface_class))


def _mesh(points: np.ndarray, faces: np.ndarray, surface_class: SurfaceClass) -> ColoredMesh:
    count = len(faces)
    return ColoredMesh(
        points, points, faces, np.full(count, int(Material.ROAD)), np.full((count, 3), 0.1),
        np.full(count, int(surface_class)),
    )  # fmt: skip
