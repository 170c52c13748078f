"""Cars, vans, trucks and buses, and a random choice among all vehicles.

Vehicles fill a box of length, width and height `size` centred at x = y = 0; their bodies are convex hulls.
"""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from drivesplat.world.shapes.mesh import METAL, Color, ColoredMesh, Material, Numbers, box, hull, symmetric_hull
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

PAINTS: tuple[Color, ...] = (
    (0.5, 0.5, 0.52), (0.55, 0.06, 0.05), (0.05, 0.12, 0.35), (0.03, 0.03, 0.04), (0.7, 0.7, 0.68), (0.08, 0.22, 0.14),
    (0.6, 0.4, 0.05), (0.16, 0.17, 0.19), (0.3, 0.5, 0.62), (0.33, 0.05, 0.09),
)  # fmt: skip
WHITE: Color = (0.7, 0.7, 0.68)
EGO_SIZE, EGO_OVERHANG = (4.08, 1.73, 1.56), 0.65
"""A Renault Zoe, and how far it extends behind its rear axle (metres)."""
BRANDS: tuple[Color, ...] = ((0.6, 0.42, 0.03), (0.04, 0.12, 0.4), (0.45, 0.05, 0.05), (0.05, 0.28, 0.12))
CARGO: Color = (0.62, 0.62, 0.6)


@dataclass(frozen=True)
class CarProfile:
    """The outline of a car from the side: x as fractions of the length from its middle, heights as fractions of the
    height. The windscreen rises from `screen` to `roof_front`, the rear window from `tail` to `roof_rear`."""

    screen: float
    roof_front: float
    roof_rear: float
    tail: float
    nose: float
    belt: float
    deck: float
    axles: tuple[float, float]
    radius: float = 0.32
    pillars: tuple[float, ...] = (0.02, 0.47, 0.5, 0.97)
    """Starts and ends of the side windows, fractions from the rear."""


SALOON = CarProfile(0.24, 0.07, -0.22, -0.38, 0.47, 0.62, 0.61, (-0.3, 0.305), pillars=(0.1, 0.46, 0.5, 0.96))
HATCHBACK = CarProfile(0.28, 0.1, -0.36, -0.47, 0.5, 0.6, 0.56, (EGO_OVERHANG / EGO_SIZE[0] - 0.5, 0.294))
ESTATE = CarProfile(
    0.22, 0.07, -0.42, -0.485, 0.55, 0.6, 0.56, (-0.3, 0.3), 0.35, pillars=(0.03, 0.24, 0.27, 0.58, 0.61, 0.97)
)


def estate(size: Numbers, color: Color) -> ColoredMesh:
    """A car whose roof reaches the tail, with roof rails: an estate, or where it is high an SUV."""
    _, width, height = size
    length = size[0]
    parts = [_passenger_car((length, width, height - 0.05), color, ESTATE)]
    for side in (-0.3, 0.3):
        low, high = (-0.36 * length, side * width - 0.02, height - 0.08), (0.0, side * width + 0.02, height)
        parts.append(box(low, high, Material.METAL, METAL))
    return assembled(parts)


def vehicle(kind: str, random: np.random.Generator) -> tuple[ColoredMesh, str]:
    """A vehicle of random size and paint, and its nuScenes category. `kind`: "car", "van", "truck" or "bus"."""
    color = PAINTS[random.integers(len(PAINTS))]
    spread = random.uniform(size=3)

    def sized(low: Numbers, high: Numbers) -> np.ndarray:
        return np.array(low) + spread * np.subtract(high, low)

    if kind == "car":
        make, low, high = (
            (car, (4.4, 1.8, 1.42), (4.9, 1.92, 1.5)),
            (hatchback, (3.8, 1.7, 1.45), (4.3, 1.82, 1.56)),
            (estate, (4.4, 1.8, 1.5), (4.8, 1.95, 1.75)),
        )[random.integers(3)]
        return make(sized(low, high), color), "vehicle.car"
    if kind == "van":
        paint = WHITE if random.uniform() < 0.6 else color
        return van(sized((5.2, 2.0, 2.3), (6.0, 2.15, 2.65)), paint), "vehicle.truck"
    if kind == "truck":
        return truck(sized((7.0, 2.4, 3.2), (9.0, 2.5, 3.6)), color), "vehicle.truck"
    if kind == "bus":
        return bus(sized((10.8, 2.5, 3.0), (11.2, 2.55, 3.2)), color), "vehicle.bus.rigid"
    raise ValueError(f"No vehicle is of the kind {kind!r}; use car, van, truck or bus.")


def ego_vehicle() -> ColoredMesh:
    """The ego vehicle in the ego frame (origin on the ground below the centre of the rear axle): what the LiDAR sees of
    it. Cameras see `ego_rear`: those of the recording vehicle stand higher than this roof."""
    return hatchback(EGO_SIZE, WHITE).moved((EGO_SIZE[0] / 2 - EGO_OVERHANG, 0.0, 0.0))


def ego_rear() -> ColoredMesh:
    """The upper rear of the ego vehicle in the ego frame: an arc at the lower edge of CAM_BACK's images, much as in
    nuScenes. No other camera sees it."""
    lip = [(-0.78, 0.0, 1.27), (-0.76, 0.4, 1.25), (-0.7, 0.75, 1.18), (-0.62, 0.85, 1.08)]
    edge = [(x, side * y, z) for x, y, z in lip for side in (-1, 1)]
    inner = [(x + 0.5, y, z) for x, y, z in edge]
    points = [*edge, *inner, (-0.8, -0.8, 0.6), (-0.8, 0.8, 0.6)]
    return assembled([hull(points, Material.PLAIN, (0.4, 0.41, 0.42))])


def _passenger_car(size: Numbers, color: Color, profile: CarProfile) -> ColoredMesh:
    length, width, height = size
    half, front = width / 2, length / 2
    belt, nose, deck = profile.belt * height, profile.nose * height, profile.deck * height
    y = half - 0.05
    # below the windows: sides that bulge at half their height, and the bonnet
    sides = [
        (-front + 0.02, 0.3 * height, 0.88 * y), (-front + 0.01, 0.5 * height, 0.9 * y),
        (-front + 0.05, deck, 0.84 * y),
        (profile.tail * length, belt, 0.93 * y), (profile.screen * length, belt, 0.93 * y),
        (front - 0.3, nose + 0.04, 0.84 * y), (front - 0.04, nose - 0.06, 0.78 * y), (front, 0.36 * height, 0.76 * y),
        (front - 0.02, 0.22 * height, 0.8 * y), (-0.4 * length, 0.4 * height, 0.98 * y),
        (0.4 * length, 0.38 * height, 0.97 * y),
        (-0.42 * length, 0.14 * height, 0.92 * y), (0.42 * length, 0.14 * height, 0.92 * y), (0.0, 0.4 * height, y),
    ]  # fmt: skip
    sill = box((-0.2 * length, -0.97 * y, 0.13 * height), (0.2 * length, 0.97 * y, 0.2 * height), Material.PLAIN, BLACK)
    body = symmetric_hull(sides, Material.PAINT, color)
    y = half - 0.06
    bumpers = [
        hull([(x + dx, side * w * y, z * height) for dx, w in ((0.0, 0.72), (-np.sign(x) * 0.26, 0.92))
              for z in (0.16, 0.26) for side in (-1, 1)], Material.PLAIN, BLACK)
        for x in (-front, front)
    ]  # fmt: skip
    grille = box((front - 0.1, -0.3 * y, 0.29 * height), (front - 0.002, 0.3 * y, 0.36 * height), Material.PLAIN, BLACK)
    badge = box((front - 0.1, -0.05, 0.38 * height), (front + 0.0, 0.05, 0.42 * height), Material.METAL, METAL)
    parts = [
        body,
        sill,
        *_cabin(length, y, height, color, profile),
        *bumpers,
        grille,
        badge,
        *lights(body, front, (0.4 * half, 0.71 * half), (nose - 0.16, nose - 0.075)),
        *lights(body, -front, (0.5 * half, 0.84 * half), (0.46 * height, 0.54 * height)),
        *plates(front, 0.28 * height),
        *axles([x * length for x in profile.axles], half - 0.055, profile.radius),
        *wing_mirrors((profile.screen - 0.07) * length, half, belt - 0.02, 0.16, color),
    ]
    for x in (0.08, -0.13):
        for side in (-1, 1):
            low, high = sorted((side * (half - 0.08), side * (half - 0.03)))
            parts.append(box((x * length - 0.1, low, belt - 0.14), (x * length + 0.1, high, belt - 0.11),
                             Material.METAL, METAL))  # fmt: skip
    return assembled(parts)


car = partial(_passenger_car, profile=SALOON)
hatchback = partial(_passenger_car, profile=HATCHBACK)
"""A small car with a steep tail."""


def _cabin(length: float, y: float, height: float, color: Color, profile: CarProfile) -> list[ColoredMesh]:
    """Pillars, roof and windows."""
    belt, top = profile.belt * height - 0.03, 0.94 * height
    rear, front = profile.tail * length, profile.screen * length
    upper_rear, upper_front, upper_y = profile.roof_rear * length, profile.roof_front * length, 0.75 * y
    y *= 0.92
    side = [(rear, y, belt), (front, y, belt), (upper_front, upper_y, top), (upper_rear, upper_y, top)]
    screen = [(front, -y, belt), (front, y, belt), (upper_front, upper_y, top), (upper_front, -upper_y, top)]
    back = [(rear, -y, belt), (rear, y, belt), (upper_rear, upper_y, top), (upper_rear, -upper_y, top)]
    roof = [(x + shift, z, w * upper_y) for z, w, inset in ((top - 0.02, 1.035, 0.0), (height, 0.75, 0.1))
            for x, shift in ((upper_rear, inset * length * 0.7), (upper_front, -inset * length))]  # fmt: skip
    frame = [(x, z, w) for x, w, z in side]
    windows = [glass(screen, (0.05, 0.95), (0.1, 0.97)), glass(back, (0.08, 0.92), (0.15, 0.93))]
    edges = profile.pillars
    for face in both_sides(side):
        windows += [glass(face, span, (0.12, 0.93)) for span in zip(edges[::2], edges[1::2], strict=True)]
    return [symmetric_hull(frame, Material.PAINT, color), symmetric_hull(roof, Material.PAINT, color), *windows]


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
