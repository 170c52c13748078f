"""What stands beside one street of the grid, and its ground, and that of a crossing.

Meshes are in the frame of their street: x metres along it from the middle of the crossing where it begins, y to its
left, z up; those of a crossing in the grid frame, from its middle. Each is drawn from a seed of its own place.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from drivesplat.world.layout import CROSSING, CURB, FURNITURE, PARKING, ROAD, SIDEWALK, TREES, WINDOW
from drivesplat.world.route.grid import CityBlock
from drivesplat.world.shapes import plants, scenery
from drivesplat.world.shapes.buildings import building_front
from drivesplat.world.shapes.mesh import ColoredMesh, Material, SurfaceClass, concatenate
from drivesplat.world.shapes.vehicles import vehicle
from drivesplat.world.street.roadside import (
    CURB_HEIGHT,
    DEPTH,
    FORECOURT,
    KERBSIDE,
    LAMP_ARM,
    LAMP_HEIGHT,
    WALLS,
    standing_building,
)

FIRST_HOUSE = SIDEWALK + FORECOURT
"""Metres from the middle of a crossing to the first house beside a street to the east; houses beside streets to the
north begin behind these."""
BEHIND = FIRST_HOUSE + 2.0 + DEPTH + 2.0
SIDE_WALLS = FIRST_HOUSE + 0.9 * DEPTH
"""Metres from the middle of a street to the east at which the side walls of its houses end at the earliest, or less."""
CLEAR = 16.0
"""Metres from the middle of a crossing within which nothing stands beside the road and nobody parks."""
ZEBRA = 15.0
"""Metres from the middle of a crossing to where the strip of road with a pedestrian crossing ends."""
PARKED_SPACING, TREE_SPACING, LAMP_SPACING = 7.2, 17.0, 24.0
MAKES, VANS = 24, 6
"""Number of different trees and cars, and of vans."""
SIGN_COLORS = ((0.6, 0.04, 0.03), (0.04, 0.1, 0.5))
BARE = -20.0
"""z in the texture of the ground where the road has no paint."""
TEXTURES = (200.0, 4000.0)
"""Least and largest x in the texture of the ground at which a street begins."""


@dataclass(frozen=True)
class House:
    """A house in the frame of its street: opposite corners (x, y) on the ground, its height, colour, and the seed of
    what protrudes from its front."""

    low: tuple[float, float]
    high: tuple[float, float]
    top: float
    color: tuple[float, float, float]
    seed: int

    def mesh(self) -> ColoredMesh:
        """Its walls and its roof."""
        return standing_building(self.low, self.high, self.top, self.color)

    def front(self) -> ColoredMesh:
        """Doors, balconies and other details of its front."""
        return building_front((*self.low, 0.0), (*self.high, self.top), np.random.default_rng(self.seed))

    @property
    def center(self) -> np.ndarray:
        return (np.array(self.low) + self.high) / 2


@dataclass(frozen=True)
class Parked:
    """A parked vehicle: its number on its street, its place, the direction in which it faces in radians, its kind, and
    its make among MAKES."""

    number: int
    x: float
    y: float
    heading: float
    kind: str
    make: int

    @property
    def vehicle(self) -> tuple[ColoredMesh, str]:
        """Its mesh and nuScenes' category."""
        return vehicle_of(self.kind, self.make)


@cache
def _tree(make: int) -> ColoredMesh:
    """A tree; some overhang what is to their left."""
    random = np.random.default_rng([5, make])
    overhang = random.uniform(1.5, 2.5) if random.uniform() < 0.4 else 0.0
    return plants.tree(random.uniform(5.0, 8.0), random, overhang)


def build_makes() -> None:
    """Builds the meshes that all streets share, once for all processes that begin later."""
    for make in range(MAKES):
        _tree(make)
        for kind in ("car", "van"):
            vehicle_of(kind, make)


def vehicle_of(kind: str, make: int) -> tuple[ColoredMesh, str]:
    """A "car" or "van" of a make among MAKES, and nuScenes' category. There are fewer makes of vans."""
    return _vehicle(kind, make % (MAKES if kind == "car" else VANS))


@cache
def _vehicle(kind: str, make: int) -> tuple[ColoredMesh, str]:
    return vehicle(kind, np.random.default_rng([4, make]))


class StreetScenery:
    """The scenery of the street `block`, `length` metres from crossing to crossing, in a grid with `random_seed`."""

    def __init__(self, block: CityBlock, length: float, random_seed: int):
        self.length, self._begin = length, FIRST_HOUSE if block.heading == 0 else BEHIND
        # seeds are not negative
        self._seed = [random_seed, 3, block.heading, *(2 * abs(c) + (c < 0) for c in block.crossing)]

    def _random(self, topic: int) -> np.random.Generator:
        return np.random.default_rng([*self._seed, topic])

    def houses(self) -> list[House]:
        """Houses on both sides."""
        random, found = self._random(0), []
        for side in (-1, 1):
            cells = int((self.length - 2 * self._begin) / WINDOW[0])
            x = self.length / 2 - cells * WINDOW[0] / 2
            while cells > 0:
                width = int(random.integers(4, 9))
                width = cells if cells - width < 4 else width
                gap = int(random.integers(0, 3))
                gap = 0 if cells - width - gap < 4 else gap
                near = side * (SIDEWALK + FORECOURT + random.uniform(0, 2.0))
                low, high = sorted((near, near + side * DEPTH))
                top, color = WINDOW[1] * int(random.integers(2, 7)), WALLS[random.integers(len(WALLS))]
                end, seed = x + width * WINDOW[0], int(random.integers(2**31))
                found.append(House((x, float(low)), (end, float(high)), float(top), color, seed))
                x, cells = end + gap * WINDOW[0], cells - width - gap
        return found

    def barriers(self) -> list[ColoredMesh]:
        """Hedges and fences across the gaps between houses."""
        random, found = self._random(1), []
        for side in (-1, 1):
            row = [house for house in self.houses() if side * house.center[1] > 0]
            ends = [(a.high[0], b.low[0]) for a, b in pairwise(row)]
            if self._begin == BEHIND:  # up to the houses at the corners
                ends += [(SIDE_WALLS, row[0].low[0]), (row[-1].high[0], self.length - SIDE_WALLS)]
            for start, end in ends:
                if end - start > 1.0:
                    width = end - start
                    barrier = plants.hedge(width, 1.1, 0.6, random) if random.uniform() < 0.6 else scenery.fence(width)
                    found.append(barrier.moved(((start + end) / 2, side * (SIDEWALK + 0.6), 0.0)))
        return found

    def _tree_places(self) -> list[tuple[float, int]]:
        """Place along the street, and side, of each tree."""
        first = self._random(2).uniform(CLEAR + 1.0, CLEAR + 5.0, 2)
        rows = ((np.arange(first[int(side > 0)], self.length - CLEAR, TREE_SPACING), side) for side in (-1, 1))
        return [(float(x), side) for places, side in rows for x in places]

    def trees(self) -> list[ColoredMesh]:
        """A row of trees on each sidewalk, some of which overhang the road."""
        random, found = self._random(6), []
        for x, side in self._tree_places():
            tree = _tree(int(random.integers(MAKES)))
            found.append(tree.moved((x, side * random.uniform(*TREES), 0.0), 0.0 if side < 0 else np.pi))
        return found

    def _between_trees(self) -> list[ColoredMesh]:
        """Benches, planters and advertising columns."""
        random, found = self._random(7), []
        for x, side in self._tree_places():
            kind, between = int(random.integers(4)), x + TREE_SPACING / 2
            if between < self.length - CLEAR:
                if kind < 2:
                    item = scenery.advertising_column(random) if kind == 0 else plants.planter(random)
                else:
                    item = scenery.bench().moved((0.0, 0.0, 0.0), 0.0 if side < 0 else np.pi)
                found.append(item.moved((between, side * 8.9, 0.0)))
        return found

    def lamps(self) -> np.ndarray:
        """Feet x, y (m, 2) of the street lamps, alternately on both sides."""
        places = np.arange(CLEAR + 2.0, self.length - CLEAR, LAMP_SPACING)
        return np.stack([places, FURNITURE * (-1.0) ** np.arange(len(places))], axis=-1)

    def furniture(self) -> list[ColoredMesh]:
        """Street lamps, signs, small things beside the curb, and what stands between the trees."""
        random, lamps = self._random(3), self.lamps()
        found = self._between_trees()
        found += [
            scenery.street_lamp(LAMP_HEIGHT, -np.sign(y) * LAMP_ARM).moved((x, y, 0.0)) for x, y in lamps.tolist()
        ]
        for side in (-1, 1):
            for x in np.arange(CLEAR + random.uniform(4.0, 8.0), self.length - CLEAR, 22.0).tolist():
                if np.abs(lamps[:, 0] - x).min(initial=np.inf) > 1.0:
                    item = KERBSIDE[random.integers(len(KERBSIDE))]()
                    found.append(item.moved((x, side * FURNITURE, 0.0)))
        # signs before the crossing that follows, for either direction
        for x, side in ((self.length - CLEAR + 1.5, -1), (CLEAR - 1.5, 1)):
            if random.uniform() < 0.6:
                sign = scenery.sign(SIGN_COLORS[random.integers(len(SIGN_COLORS))])
                found.append(sign.moved((x, side * FURNITURE, 0.0), 0.0 if side < 0 else np.pi))
        return found

    def parked(self, number: int) -> list[Parked]:
        """At most `number` parked vehicles on both sides."""
        random, found = self._random(4), []
        places = np.arange(CLEAR + 4.0, self.length - CLEAR - 3.0, PARKED_SPACING).tolist()
        free = [(x, side) for x in places for side in (-1, 1)]
        for i, index in enumerate(random.permutation(len(free))[:number].tolist()):
            (x, side), kind = free[index], "van" if i % 5 == 4 else "car"
            y, make = side * (PARKING + random.uniform(-0.1, 0.1)), int(random.integers(MAKES))
            found.append(Parked(i, x, float(y), 0.0 if side < 0 else np.pi, kind, make))
        return found

    def ground(self) -> list[ColoredMesh]:
        """Road with pedestrian crossings at some ends, curbs and sidewalks, without the squares around crossings."""
        random = self._random(5)
        offset, zebras = random.uniform(*TEXTURES), random.uniform(size=2) < 0.6
        end = self.length - SIDEWALK
        road = [(ZEBRA, self.length - ZEBRA, offset)]
        # the texture has one pedestrian crossing
        at = (SIDEWALK + ZEBRA) / 2 - (CROSSING[0] + CROSSING[1]) / 2
        road.append((SIDEWALK, ZEBRA, -at if zebras[0] else offset))
        road.append((self.length - ZEBRA, end, at - self.length if zebras[1] else offset))
        parts = [_strip((a, b), (-ROAD, ROAD), SurfaceClass.ROAD, shift) for a, b, shift in road]
        for side in (-1, 1):
            parts.append(_strip((SIDEWALK, end), _sorted(side * ROAD, side * SIDEWALK), SurfaceClass.SIDEWALK, offset))
            low, high = _sorted(side * ROAD, side * CURB)
            profile = np.array([(low, -0.02), (low, CURB_HEIGHT), (high, CURB_HEIGHT), (high, -0.02)])
            corners = np.array([[(x, y, z) for y, z in profile] for x in (SIDEWALK, end)])
            texture = corners + np.array([offset, 0.0, 0.0])
            parts += [_quads(corners[:, i : i + 2], texture[:, i : i + 2], SurfaceClass.SIDEWALK) for i in range(3)]
        return parts


@cache
def crossing_ground() -> ColoredMesh:
    """The square around the middle of a crossing: road without paint, with rounded corners of sidewalk."""
    reach = np.array([-SIDEWALK, -ROAD, ROAD, SIDEWALK])
    parts = []
    for (a, b), (c, d) in (((0, 3), (1, 2)), ((1, 2), (0, 1)), ((1, 2), (2, 3))):
        corners = np.array([[(x, y, 0.0) for y in (reach[c], reach[d])] for x in (reach[a], reach[b])])
        parts.append(_quads(corners, _bare(corners), SurfaceClass.ROAD))
    radius, angles = SIDEWALK - ROAD, np.linspace(np.pi, 1.5 * np.pi, 9)
    for quarter in range(4):
        turn = np.pi / 2 * quarter
        arc, inner = (
            SIDEWALK + r * np.stack([np.cos(angles), np.sin(angles)], axis=-1) for r in (radius, radius - (CURB - ROAD))
        )
        flat = [np.column_stack([points, np.zeros(len(points))]) for points in (arc, inner)]
        apex = np.broadcast_to((ROAD, ROAD, 0.0), flat[0].shape)
        center = np.broadcast_to((SIDEWALK, SIDEWALK, 0.0), flat[0].shape)
        rows = [np.stack(pair, axis=1) for pair in ((flat[0], apex), (center, flat[0]))]
        paved = rows[1] * (1.0, (SIDEWALK - CURB - 0.1) / radius, 1.0)
        paved[..., 1] += SIDEWALK - 0.05 - paved[..., 1].max()
        found = [_quads(rows[0], _bare(rows[0]), SurfaceClass.ROAD), _quads(rows[1], paved, SurfaceClass.SIDEWALK)]
        length = radius * (angles - angles[0])
        profile = ((flat[0], -0.02, ROAD), (flat[0], CURB_HEIGHT, ROAD), (flat[1], CURB_HEIGHT, CURB),
                   (flat[1], -0.02, CURB))  # fmt: skip
        stone = np.stack([points + np.array([0.0, 0.0, z]) for points, z, _ in profile], axis=1)
        texture = np.stack([np.stack([length, np.full(9, y), np.full(9, z)], axis=-1) for _, z, y in profile], axis=1)
        texture[..., 1] = np.clip(texture[..., 1], ROAD + 0.01, CURB - 0.01)
        found += [_quads(stone[:, i : i + 2], texture[:, i : i + 2], SurfaceClass.SIDEWALK) for i in range(3)]
        parts += [mesh.moved((0.0, 0.0, 0.0), turn) for mesh in found]
    return concatenate(parts)


def grass(low: np.ndarray, high: np.ndarray, z: float = 0.0) -> ColoredMesh:
    """Level grass between two corners (2,)."""
    corners = np.array([[(x, y, z) for y in (low[1], high[1])] for x in (low[0], high[0])])
    return _quads(corners, corners + np.array([0.0, 2 * SIDEWALK - low[1], 0.0]), SurfaceClass.TERRAIN)


def _sorted(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a < b else (b, a)


def _bare(corners: np.ndarray) -> np.ndarray:
    """The texture of road without paint."""
    return np.concatenate([corners[..., :2], np.full((*corners.shape[:-1], 1), BARE)], axis=-1)


def _strip(along: tuple[float, float], across: tuple[float, float], kind: SurfaceClass, shift: float) -> ColoredMesh:
    """A level rectangle of ground, whose texture begins `shift` metres farther along."""
    corners = np.array([[(x, y, 0.0) for y in across] for x in along])
    return _quads(corners, corners + np.array([shift, 0.0, 0.0]), kind)


def _quads(corners: np.ndarray, texture: np.ndarray, kind: SurfaceClass) -> ColoredMesh:
    """A strip of ground between pairs of points (n, 2, 3), with the texture coordinates of these."""
    first = 2 * np.arange(len(corners) - 1)
    faces = np.concatenate([np.stack([first, first + 2, first + 3], 1), np.stack([first, first + 3, first + 1], 1)])
    count = len(faces)
    return ColoredMesh(
        corners.reshape(-1, 3), texture.reshape(-1, 3), faces, np.full(count, int(Material.ROAD)),
        np.full((count, 3), 0.1), np.full(count, int(kind)),
    )  # fmt: skip
