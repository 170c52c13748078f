"""Delivery vans, box trucks and city buses; see vehicles.py."""

from itertools import pairwise

import numpy as np

from drivesplat.world.shapes.mesh import METAL, Color, ColoredMesh, Material, Numbers, box, symmetric_hull
from drivesplat.world.shapes.vehicle_parts import (
    BLACK,
    HEADLIGHT,
    assembled,
    axles,
    both_sides,
    brand_panel,
    glass,
    lights,
    pane,
    plates,
    wing_mirrors,
)  # fmt: skip

BRANDS: tuple[Color, ...] = ((0.6, 0.42, 0.03), (0.04, 0.12, 0.4), (0.45, 0.05, 0.05), (0.05, 0.28, 0.12))
CARGO: Color = (0.62, 0.62, 0.6)


def van(size: Numbers, color: Color) -> ColoredMesh:
    """A delivery van with a brand panel on either side."""
    length, width, height = size
    front, y = length / 2, width / 2 - 0.08
    cargo = [(x, z * height, w * y) for x in (-front + 0.03, 0.2 * length)
             for z, w in ((0.14, 0.98), (0.5, 1.0), (0.9, 0.95), (1.0, 0.84))]  # fmt: skip
    belt, top, base, roof = 0.52 * height, 0.93 * height, 0.465 * length, 0.33 * length
    cab = [
        (0.19 * length, 0.14 * height, 0.98 * y), (0.19 * length, 0.5 * height, y), (0.19 * length, top, 0.9 * y),
        (roof, top, 0.86 * y), (base, belt, 0.9 * y), (front - 0.03, 0.4 * height, 0.84 * y),
        (front, 0.28 * height, 0.85 * y), (front - 0.03, 0.12 * height, 0.86 * y),
    ]  # fmt: skip
    screen = [(base, -0.9 * y, belt), (base, 0.9 * y, belt), (roof, 0.86 * y, top), (roof, -0.86 * y, top)]
    cab_door = [(0.19 * length, y, 0.5 * height), (base, 0.9 * y, belt), (roof, 0.86 * y, top),
            (0.19 * length, 0.9 * y, top)]  # fmt: skip
    windows = [glass(screen, (0.06, 0.94), (0.06, 0.92))]
    windows += [glass(face, (0.16, 0.88), (0.12, 0.86)) for face in both_sides(cab_door)]
    body, nose = symmetric_hull(cargo, Material.PAINT, color), symmetric_hull(cab, Material.PAINT, color)
    brand = BRANDS[int(1000 * sum(color)) % len(BRANDS)]
    panels = [
        brand_panel((-0.4 * length, s * y - 0.012, 0.45 * height), (0.08 * length, s * y + 0.012, 0.72 * height), brand)
        for s in (-1, 1)
    ]
    parts = [
        body, nose, *windows, *panels,
        *_rear_doors(-front + 0.03, 0.88 * y, (0.16 * height, 0.9 * height)), *_bumpers(front, 0.9 * y, 0.2),
        *lights(nose, front, (0.5 * y, 0.82 * y), (0.3 * height, 0.37 * height)),
        *lights(body, -front, (0.86 * y, 0.97 * y), (0.34 * height, 0.5 * height)), *plates(front, 0.3),
        *axles((-0.31 * length, 0.32 * length), y + 0.01, 0.34),
        *wing_mirrors(0.38 * length, width / 2, belt, 0.26, BLACK),
    ]  # fmt: skip
    return assembled(parts)


def truck(size: Numbers, color: Color) -> ColoredMesh:
    """A truck with a cab in `color`, a cargo box, and bars against driving under it."""
    length, width, height = size
    front, y = length / 2, width / 2 - 0.1
    wall = front - 1.75  # between cab and cargo
    side = width / 2 - 0.02
    cargo = box((-front + 0.04, -side, 1.05), (wall - 0.12, side, height), Material.PLAIN, CARGO)
    frame = box((-front + 0.25, -0.45, 0.6), (front - 0.4, 0.45, 1.02), Material.PLAIN, BLACK)
    brand = BRANDS[int(1000 * sum(color)) % len(BRANDS)]
    middle, reach = (wall - front) / 2, 0.28 * length
    panels = [
        brand_panel((middle - reach, s * side - 0.01, 1.5), (middle + reach, s * side + 0.01, 2.9), brand)
        for s in (-1, 1)
    ]
    bars = [
        box((-0.22 * length, s * (y - 0.03) - 0.02, z), (0.14 * length, s * (y - 0.03) + 0.02, z + 0.1),
            Material.METAL, METAL)
        for s in (-1, 1) for z in (0.5, 0.75)
    ]  # fmt: skip
    bars += [box((-front + 0.02, -y, 0.42), (-front + 0.1, y, 0.54), Material.METAL, METAL)]
    beam = box((-front + 0.06, -y, 0.6), (-front + 0.2, y, 1.0), Material.PLAIN, BLACK)
    cab = _truck_cab(wall, front, y, height, color)
    bars += [box((x - 0.03, s * (y - 0.1) - 0.03, 0.5), (x + 0.03, s * (y - 0.1) + 0.03, 1.06), Material.PLAIN, BLACK)
             for s in (-1, 1) for x in (-0.2 * length, 0.12 * length)]  # fmt: skip
    edges = [
        box((x - 0.03, s * side - 0.005, 1.08), (x + 0.03, s * side + 0.005, height - 0.02), Material.METAL, METAL)
        for x in (-front + 0.08, wall - 0.17) for s in (-1, 1)
    ]  # fmt: skip
    parts = [
        cargo, frame, *panels, *bars, *edges, beam, *cab,
        *_rear_doors(-front + 0.04, width / 2 - 0.06, (1.1, height - 0.06)), *_bumpers(front, y, 0.35)[1:],
        *lights(cab[0], front, (0.6 * y, 0.92 * y), (0.62, 0.8)),
        *lights(beam, -front, (0.75 * y, 0.97 * y), (0.68, 0.88)), *plates(front, 0.42),
        *axles((-0.27 * length, front - 1.25), y + 0.04, 0.46),
        *wing_mirrors(front - 0.32, width / 2, 1.75, 0.5, BLACK),
    ]  # fmt: skip
    return assembled(parts)


def bus(size: Numbers, color: Color) -> ColoredMesh:
    """A city bus with doors on the right."""
    length, width, height = size
    front, y = length / 2, width / 2 - 0.09
    top = height - 0.2
    ends = ((-front + 0.02, 0.97), (-front + 0.12, 1.0), (front - 0.18, 1.0), (front - 0.02, 0.93))
    shell = [(x, z, w * s * y) for x, w in ends for z, s in ((0.3, 1.0), (top - 0.2, 1.0), (top, 0.9))]
    roof = box((-0.3 * length, -0.6 * y, top - 0.02), (0.05 * length, 0.6 * y, height), Material.PLAIN, CARGO)
    skirt = box((-front + 0.2, -0.98 * y, 0.22), (front - 0.25, 0.98 * y, 0.36), Material.PLAIN, BLACK)
    side = [
        (-front + 0.12, y, 0.3),
        (front - 0.18, y, 0.3),
        (front - 0.18, y, top - 0.2),
        (-front + 0.12, y, top - 0.2),
    ]
    left, right = both_sides(side)
    bays = np.linspace(0.03, 0.985, 8)
    doors = (1, 4, 6)
    body = symmetric_hull(shell, Material.PAINT, color)
    parts = [body, roof, skirt]
    for i, (start, end) in enumerate(pairwise(bays)):
        parts.append(glass(left, (start, end - 0.012), (0.42, 0.95)))
        if i in doors:
            middle = (start + end) / 2
            parts += [glass(right, span, (0.03, 0.95)) for span in ((start, middle - 0.004), (middle, end - 0.012))]
        else:
            parts.append(glass(right, (start, end - 0.012), (0.42, 0.95)))
    nose = front - 0.02
    screen = [(nose, -0.93 * y, 0.3), (nose, 0.93 * y, 0.3), (nose, 0.93 * y, top - 0.2), (nose, -0.93 * y, top - 0.2)]
    display = box(
        (nose - 0.1, -0.6 * y, top - 0.38), (nose + 0.01, 0.6 * y, top - 0.1), Material.LAMP, (0.5, 0.3, 0.03)
    )
    tail = [(-x, w, z) for x, w, z in screen]
    parts += [
        glass(screen, (0.02, 0.98), (0.3, 0.88)), display, glass(tail, (0.1, 0.9), (0.55, 0.92)),
        pane(tail, (0.15, 0.85), (0.12, 0.4), Material.PLAIN, BLACK),
        brand_panel((-0.2 * length, y - 0.012, 0.55), (0.1 * length, y + 0.012, 1.0), BRANDS[0]),
        *lights(body, front, (0.6 * y, 0.9 * y), (0.6, 0.78)),
        *lights(body, -front, (0.8 * y, 0.92 * y), (0.7, 1.1)), *plates(front, 0.4),
        *axles((-0.26 * length, 0.28 * length), y + 0.02, 0.48), *_bumpers(front, 0.92 * y, 0.32),
        *wing_mirrors(front - 0.2, width / 2, 1.9, 0.4, BLACK),
    ]  # fmt: skip
    return assembled(parts)


def _truck_cab(wall: float, front: float, y: float, height: float, color: Color) -> list[ColoredMesh]:
    """The cab between x = `wall` and `front`, with a deflector on its roof."""
    top, belt, base, roof = 0.8 * height, 1.45, front - 0.06, front - 0.3
    shell = [(wall, 0.55, 0.98 * y), (wall, top, 0.94 * y), (roof, top, 0.9 * y), (base, belt, 0.97 * y),
             (front - 0.02, 0.9, 0.96 * y), (front - 0.02, 0.4, 0.95 * y), (wall, belt, y)]  # fmt: skip
    screen = [(base, -0.97 * y, belt), (base, 0.97 * y, belt), (roof, 0.9 * y, top), (roof, -0.9 * y, top)]
    side = [(wall, y, belt), (base, 0.97 * y, belt), (roof, 0.9 * y, top), (wall, 0.94 * y, top)]
    deflector = [(wall, top - 0.02, 0.8 * y), (roof - 0.2, top - 0.02, 0.8 * y), (wall, height - 0.06, 0.75 * y)]
    grille = [box((front - 0.1, -0.7 * y, z), (front - 0.004, 0.7 * y, z + 0.07), Material.PLAIN, BLACK)
              for z in (0.85, 0.98, 1.11)]  # fmt: skip
    windows = [glass(face, (0.3, 0.93), (0.08, 0.82)) for face in both_sides(side)]
    marker = box((roof - 0.1, -0.2, top - 0.01), (roof, 0.2, top + 0.04), Material.LAMP, HEADLIGHT)
    return [
        symmetric_hull(shell, Material.PAINT, color), symmetric_hull(deflector, Material.PAINT, color), *windows,
        glass(screen, (0.05, 0.95), (0.03, 0.86)), *grille, marker,
    ]  # fmt: skip


def _rear_doors(x: float, y: float, heights: tuple[float, float]) -> list[ColoredMesh]:
    """The seams, hinges and lock bars of a pair of doors at the rear."""
    low, high = heights
    seams = [box((x - 0.008, c - 0.012, low), (x + 0.01, c + 0.012, high), Material.PLAIN, BLACK) for c in (-y, 0.0, y)]
    locks = [box((x - 0.03, c - 0.015, low + 0.05), (x + 0.01, c + 0.015, high - 0.05), Material.METAL, METAL)
             for c in (-0.25, 0.25)]  # fmt: skip
    hinges = [box((x - 0.02, s * y - 0.05, z), (x + 0.01, s * y + 0.05, z + 0.05), Material.METAL, METAL)
              for s in (-1, 1) for z in np.linspace(low + 0.15, high - 0.2, 3)]  # fmt: skip
    return [*seams, *locks, *hinges]


def _bumpers(front: float, y: float, z: float) -> list[ColoredMesh]:
    """Dark bars at the rear and the front."""
    return [
        box((x - 0.05, -y, z), (x + 0.05, y, z + 0.2), Material.PLAIN, BLACK) for x in (-front + 0.06, front - 0.06)
    ]
