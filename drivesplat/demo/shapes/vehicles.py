"""Vehicles: convex hulls with wheels and lights."""

from collections.abc import Sequence

from drivesplat.demo.shapes.mesh import (
    METAL,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    SurfaceClass,
    box,
    concatenate,
    cylinder,
    hull,
    symmetric_hull,
)  # fmt: skip

TAIL_LIGHT, HEADLIGHT, WINDSCREEN = (0.75, 0.05, 0.04), (0.95, 0.95, 0.85), (0.02, 0.025, 0.03)


def car(size: Numbers, color: Color) -> ColoredMesh:
    """A saloon of length, width and height `size`."""
    length, width, height = size
    front, y, belt = length / 2, width / 2, 0.58 * height
    lower = [
        (-front, 0.45 * belt, 0.94 * y), (-front, 0.92 * belt, 0.9 * y), (-0.3 * length, belt, y),
        (0.2 * length, 0.98 * belt, y), (front, 0.72 * belt, 0.88 * y), (front, 0.32 * belt, 0.9 * y),
        (-0.45 * length, 0.2 * height, 0.97 * y), (0.45 * length, 0.18 * height, 0.97 * y),
    ]  # fmt: skip
    glass = [
        (-0.4 * length, belt, 0.9 * y), (0.2 * length, 0.97 * belt, 0.92 * y),
        (-0.28 * length, 0.97 * height, 0.74 * y), (0.04 * length, 0.97 * height, 0.74 * y),
    ]  # fmt: skip
    roof = [
        (-0.27 * length, 0.96 * height, 0.72 * y), (0.03 * length, 0.96 * height, 0.72 * y),
        (-0.2 * length, height, 0.62 * y), (-0.03 * length, height, 0.62 * y),
    ]  # fmt: skip
    parts = [
        symmetric_hull(lower, Material.PAINT, color),
        symmetric_hull(glass, Material.GLASS, WINDSCREEN),
        symmetric_hull(roof, Material.PAINT, color),
    ]
    return _vehicle([*parts, *_wheels(size, 0.32 * length), *_lights(size, 0.62 * belt)])


def van(size: Numbers, color: Color) -> ColoredMesh:
    """A delivery van of length, width and height `size`."""
    length, width, height = size
    front, y = length / 2, width / 2
    cargo = box((-front, -y, 0.2 * height), (0.22 * length, y, height), Material.PAINT, color)
    cab = [
        (0.22 * length, 0.2 * height, y), (0.22 * length, 0.92 * height, 0.94 * y),
        (0.33 * length, 0.9 * height, 0.9 * y), (front, 0.5 * height, 0.94 * y), (front, 0.16 * height, 0.96 * y),
    ]  # fmt: skip
    screen = [
        (0.31 * length, 0.86 * height, 0.82 * y), (0.36 * length, 0.86 * height, 0.82 * y),
        (0.43 * length, 0.6 * height, 0.88 * y), (0.48 * length, 0.57 * height, 0.86 * y),
    ]  # fmt: skip
    parts = [cargo, symmetric_hull(cab, Material.PAINT, color), symmetric_hull(screen, Material.GLASS, WINDSCREEN)]
    return _vehicle([*parts, *_wheels(size, 0.33 * length), *_lights(size, 0.38 * height)])


def ego_rear() -> ColoredMesh:
    """The upper rear of the ego vehicle in the ego frame: an arc at the lower edge of CAM_BACK's images, much as in
    nuScenes. No other camera sees it."""
    lip = [(-0.78, 0.0, 1.27), (-0.76, 0.4, 1.25), (-0.7, 0.75, 1.18), (-0.62, 0.85, 1.08)]
    edge = [(x, side * y, z) for x, y, z in lip for side in (-1, 1)]
    inner = [(x + 0.5, y, z) for x, y, z in edge]
    return hull([*edge, *inner, (-0.8, -0.8, 0.6), (-0.8, 0.8, 0.6)], Material.PLAIN, (0.4, 0.41, 0.42))


def _wheels(size: Numbers, axle: float) -> list[ColoredMesh]:
    half, radius = size[1] / 2, 0.33
    tyres_and_rims = ((half - 0.24, half - 0.01, radius, TYRE), (half - 0.02, half, 0.19, METAL))
    return [
        cylinder((x, side * inner, radius), (x, side * outer, radius), size, Material.PLAIN, color)
        for inner, outer, size, color in tyres_and_rims
        for x in (-axle, axle)
        for side in (-1, 1)
    ]


def _lights(size: Numbers, z: float) -> list[ColoredMesh]:
    front, y = size[0] / 2, size[1] / 2
    lights = []
    for side in (-0.72, 0.72):
        low, high = side * y - 0.14, side * y + 0.14
        lights.append(box((-front - 0.02, low, z), (-front + 0.1, high, z + 0.16), Material.LAMP, TAIL_LIGHT))
        lights.append(box((front - 0.15, low, z - 0.1), (front + 0.02, high, z + 0.04), Material.LAMP, HEADLIGHT))
    plate = box((-front - 0.01, -0.26, z - 0.16), (-front + 0.1, 0.26, z - 0.04), Material.PLAIN, (0.8, 0.8, 0.75))
    return [*lights, plate]


def _vehicle(parts: Sequence[ColoredMesh]) -> ColoredMesh:
    return concatenate(parts).classified(SurfaceClass.VEHICLE)


PAINTS: tuple[Color, ...] = (
    (0.5, 0.5, 0.52), (0.55, 0.06, 0.05), (0.05, 0.12, 0.35), (0.03, 0.03, 0.04), (0.7, 0.7, 0.68), (0.08, 0.22, 0.14),
    (0.6, 0.4, 0.05),
)  # fmt: skip


def vehicle(kind, random):
    """Provisional."""
    color = PAINTS[random.integers(len(PAINTS))]
    if kind != "car":
        return van((5.4, 2.05, 2.5), (0.7, 0.7, 0.68)), "vehicle.truck"
    size = (random.uniform(4.2, 4.8), random.uniform(1.78, 1.9), random.uniform(1.45, 1.6))
    return car(size, color), "vehicle.car"


def ego_vehicle():
    """Provisional."""
    return box((-0.6, -0.85, 0.3), (3.4, 0.85, 1.5), Material.PAINT, (0.5, 0.5, 0.5)).classified(SurfaceClass.VEHICLE)
