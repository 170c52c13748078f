"""Buildings, and what protrudes from them: doors, balconies, awnings, signs."""

from dataclasses import replace
from functools import cache

import numpy as np

from drivesplat.world.layout import WINDOW
from drivesplat.world.shapes.mesh import (
    METAL,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    SurfaceClass,
    box,
    concatenate,
    cylinder,
    hull,
)

STONE, IRON, WOOD = (0.42, 0.4, 0.37), (0.04, 0.04, 0.045), (0.2, 0.11, 0.05)
AWNINGS: tuple[Color, ...] = ((0.5, 0.06, 0.05), (0.06, 0.2, 0.12), (0.08, 0.12, 0.35), (0.6, 0.5, 0.3))


def building(low: Numbers, high: Numbers, color: Color, random: np.random.Generator | None = None) -> ColoredMesh:
    """A building between two corners, with a flat roof. Whole cells of the facade's texture fit on every side.

    With `random`, doors, awnings, signs, balconies and a cornice protrude from the side along x that is nearer to
    y = 0, by 1.3 m at most.
    """
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    roof_low, roof_high = (low[0] - 0.3, low[1] - 0.3, high[2]), (high[0] + 0.3, high[1] + 0.3, high[2] + 0.4)
    walls = box(low, high, Material.FACADE, color)
    # the texture is stretched so that whole cells fit, and starts at a whole cell
    cells = np.array([WINDOW[0], WINDOW[0], WINDOW[1]])
    count = np.maximum(1, np.round((high - low) / cells))
    first = np.array([*np.floor(low[:2] / WINDOW[0]), 0.0])
    texture = cells * (first + count * (walls.vertices - low) / (high - low))
    parts = [replace(walls, texture=texture), box(roof_low, roof_high, Material.PLAIN, METAL)]
    if random is not None:
        parts.append(building_front(low, high, random))
    return concatenate(parts).classified(SurfaceClass.BUILDING)


def building_front(low: Numbers, high: Numbers, random: np.random.Generator) -> ColoredMesh:
    """What protrudes from the front of a building between two corners; see `building`."""
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    front = low[1] if abs(low[1]) <= abs(high[1]) else high[1]
    columns, floors = (max(1, round(size / cell)) for size, cell in zip((high - low)[::2], WINDOW, strict=True))
    cell = np.array([(high[0] - low[0]) / columns, 1.0, (high[2] - low[2]) / floors])
    details = concatenate(_front(columns, floors, cell, random)).classified(SurfaceClass.BUILDING)
    turn = 0.0 if front == high[1] else np.pi
    return details.moved((low[0] if turn == 0.0 else high[0], front, low[2]), turn)


@cache
def awning(width: float, color: Color) -> ColoredMesh:
    """A shop's awning on a wall along x at y = 0, towards y, 2.35 to 2.95 m above the ground."""
    half = width / 2
    cloth = hull(
        [(x, y, z) for x in (-half, half) for y, z in ((0.0, 2.95), (0.0, 2.9), (1.2, 2.4), (1.2, 2.37))],
        Material.CLOTH,
        color,
    )
    valance = [
        box((x, 1.17, 2.2), (x + 0.9 * step, 1.19, 2.41), Material.CLOTH, shade)
        for step in (width / 12,)
        for x, shade in zip(np.linspace(-half, half - step, 12), [color, (0.7, 0.68, 0.62)] * 6, strict=True)
    ]
    arms = [cylinder((x, 0.0, 2.45), (x, 1.15, 2.38), 0.015, Material.METAL, METAL) for x in (-half + 0.1, half - 0.1)]
    return concatenate([cloth, *valance, *arms]).classified(SurfaceClass.BUILDING)


@cache
def balcony(width: float) -> ColoredMesh:
    """A balcony on a wall along x at y = 0, towards y: a slab below z = 0 and a railing 1 m high."""
    half, depth = width / 2, 0.9
    slab = box((-half, -0.02, -0.14), (half, depth, 0.0), Material.PLAIN, STONE)
    rails = [
        box((-half, depth - 0.05, 0.96), (half, depth - 0.01, 1.0), Material.METAL, IRON),
        *(
            box((x - 0.02, 0.0, 0.96), (x + 0.02, depth - 0.05, 1.0), Material.METAL, IRON)
            for x in (-half + 0.03, half - 0.03)
        ),
    ]
    bars = [
        box((x - 0.008, depth - 0.04, 0.0), (x + 0.008, depth - 0.024, 0.97), Material.METAL, IRON)
        for x in np.arange(-half + 0.03, half, 0.14)
    ]
    sides = [
        box((x - 0.008, y - 0.008, 0.0), (x + 0.008, y + 0.008, 0.97), Material.METAL, IRON)
        for x in (-half + 0.03, half - 0.03)
        for y in np.arange(0.12, depth - 0.1, 0.14)
    ]
    return concatenate([slab, *rails, *bars, *sides]).classified(SurfaceClass.BUILDING)


@cache
def front_door(color: Color) -> ColoredMesh:
    """An entrance on a wall along x at y = 0, towards y: a frame, a door with a handle, a step, a small roof."""
    parts = [
        box((-0.68, -0.02, 0.0), (-0.52, 0.16, 2.4), Material.PLAIN, STONE),
        box((0.52, -0.02, 0.0), (0.68, 0.16, 2.4), Material.PLAIN, STONE),
        box((-0.68, -0.02, 2.4), (0.68, 0.2, 2.6), Material.PLAIN, STONE),
        box((-0.52, -0.02, 0.0), (0.52, 0.05, 2.4), Material.PLAIN, color),
        box((-0.75, -0.02, 0.0), (0.75, 0.45, 0.15), Material.PLAIN, STONE),
        box((-0.4, 0.04, 1.3), (0.4, 0.06, 2.2), Material.GLASS, (0.03, 0.035, 0.04)),
        box((0.38, 0.04, 0.95), (0.43, 0.11, 1.2), Material.METAL, METAL),
        box((-0.9, -0.02, 2.68), (0.9, 0.7, 2.76), Material.PLAIN, METAL),
    ]
    return concatenate(parts).classified(SurfaceClass.BUILDING)


@cache
def hanging_sign(color: Color) -> ColoredMesh:
    """A shop's sign across a wall along x at y = 0, towards y, 2.7 m above the ground."""
    panel = box((-0.04, 0.15, 2.7), (0.04, 0.85, 3.2), Material.SIGN, color)
    panel = replace(panel, texture=panel.vertices - panel.vertices.mean(axis=0))
    bar = cylinder((0.0, 0.0, 3.25), (0.0, 0.9, 3.25), 0.02, Material.METAL, METAL)
    return concatenate([panel, bar]).classified(SurfaceClass.BUILDING)


def _front(columns: int, floors: int, cell: np.ndarray, random: np.random.Generator) -> list[ColoredMesh]:
    """Details of a front along x at y = 0 that faces y, with cells of size `cell` (3,)."""
    parts = [box((-0.05, -0.05, floors * cell[2] - 0.3), (columns * cell[0] + 0.05, 0.3, floors * cell[2] - 0.05),
                 Material.PLAIN, STONE)]  # fmt: skip
    entrance = int(random.integers(columns))
    sill = box((-0.85, -0.02, 0.72), (0.85, 0.12, 0.8), Material.PLAIN, STONE)
    platform = balcony(0.8 * cell[0])
    with_balconies = random.uniform() < 0.5
    for column in range(columns):
        center, color = (column + 0.5) * cell[0], AWNINGS[random.integers(len(AWNINGS))]
        if column == entrance:
            parts.append(front_door(WOOD if random.uniform() < 0.5 else color).moved((center, 0.0, 0.0)))
        elif random.uniform() < 0.4:
            parts.append(awning(0.9 * cell[0], color).moved((center, 0.0, 0.0)))
        elif random.uniform() < 0.3:
            parts.append(hanging_sign(color).moved((center - 0.47 * cell[0], 0.0, 0.0)))
        parts.append(box((column * cell[0] - 0.12, -0.05, 0.0), (column * cell[0] + 0.12, 0.1, cell[2] - 0.2),
                         Material.PLAIN, STONE))  # fmt: skip
        for floor in range(1, floors):
            if with_balconies and (column + floor) % 2 == 0:
                parts.append(platform.moved((center, 0.0, floor * cell[2] + 0.05)))
            else:
                parts.append(sill.moved((center, 0.0, floor * cell[2])))
    pipe = columns * cell[0] - 0.25
    parts.append(cylinder((pipe, 0.08, 0.0), (pipe, 0.08, floors * cell[2] - 0.2), 0.05, Material.METAL, METAL))
    return parts
