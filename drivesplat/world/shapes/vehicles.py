"""Cars, and a random choice among all vehicles.

Vehicles fill a box of length, width and height `size` centred at x = y = 0; their bodies are convex hulls.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from drivesplat.world.shapes.mesh import METAL, Color, ColoredMesh, Material, Numbers, box, hull, symmetric_hull
from drivesplat.world.shapes.utility_vehicles import bus, truck, van
from drivesplat.world.shapes.vehicle_parts import (
    BLACK,
    assembled,
    axles,
    both_sides,
    glass,
    lights,
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
