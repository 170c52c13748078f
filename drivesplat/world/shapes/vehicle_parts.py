"""Parts that vehicles share: wheels, panes on flat faces, lights, mirrors, panels."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import trimesh

from drivesplat.world.shapes.mesh import (
    METAL,
    TYRE,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    SurfaceClass,
    box,
    concatenate,
    hull,
    uniform,
)  # fmt: skip

TAIL_LIGHT, HEADLIGHT, WINDSCREEN = (0.75, 0.05, 0.04), (0.95, 0.95, 0.85), (0.02, 0.025, 0.03)
BLACK, PLATE = (0.02, 0.02, 0.022), (0.8, 0.8, 0.75)
SPOKES = 5


def assembled(parts: Sequence[ColoredMesh]) -> ColoredMesh:
    """One mesh of the parts of a vehicle."""
    return concatenate(parts).classified(SurfaceClass.VEHICLE)


def disc(center: Numbers, width: float, radius: float, material: Material, color: Color) -> ColoredMesh:
    """A cylinder about the y axis."""
    mesh = trimesh.creation.cylinder(radius, width, sections=20)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    mesh.apply_translation(center)
    return uniform(mesh, material, color)


def wheel(x: float, outer: float, radius: float) -> list[ColoredMesh]:
    """A wheel at `x` whose outside is at y = `outer`, on the ground, before the dark inset of its arch."""
    side, width = np.sign(outer), 0.2
    arch = disc((x, outer - side * 0.16, 1.18 * radius), 0.29, 1.16 * radius, Material.PLAIN, BLACK)
    tyre = disc((x, outer - side * (0.005 + width / 2), radius), width, radius, Material.PLAIN, TYRE)
    rim = disc((x, outer - side * 0.016, radius), 0.026, 0.66 * radius, Material.PLAIN, BLACK)
    hub = disc((x, outer - side * 0.01, radius), 0.02, 0.16 * radius, Material.METAL, METAL)
    low, high = (-0.024, -0.009, 0.1 * radius), (0.024, 0.009, 0.64 * radius)
    bar = box(low, high, Material.METAL, METAL)
    spokes = []
    for k in range(SPOKES):
        pose = trimesh.transformations.rotation_matrix(2 * np.pi * k / SPOKES + x, [0.0, 1.0, 0.0])
        pose[:3, 3] = x, outer - side * 0.009, radius
        spokes.append(bar.transformed(pose))
    return [arch, tyre, rim, hub, *spokes]


def axles(positions: Sequence[float], half_width: float, radius: float) -> list[ColoredMesh]:
    """Wheels on both sides at each of the positions x."""
    return [part for x in positions for side in (-1, 1) for part in wheel(x, side * half_width, radius)]


def pane(
    corners: Sequence[Numbers], along: tuple[float, float], up: tuple[float, float], material: Material, color: Color
) -> ColoredMesh:
    """A slab 1 cm thick around a flat face, on the part of it between fractions `along` and `up`. The corners are
    bottom start, bottom end, top end, top start."""
    a, b, c, d = (np.array(corner, dtype=float) for corner in corners)
    normal = np.cross(b - a, d - a)
    normal *= 0.005 / np.linalg.norm(normal)
    points = [(1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * d + s * c) for s in along for t in up]
    return hull([point + sign * normal for point in points for sign in (-1, 1)], material, color)


glass = partial(pane, material=Material.GLASS, color=WINDSCREEN)
"""A window on a flat face."""


def both_sides(corners: Sequence[Numbers]) -> list[list[tuple[float, float, float]]]:
    """A face at y > 0 and its mirror image."""
    return [[(x, side * y, z) for x, y, z in corners] for side in (1, -1)]


def brand_panel(low: Numbers, high: Numbers, color: Color) -> ColoredMesh:
    """A panel with lettering, whose texture is centred on it."""
    panel = box(low, high, Material.SIGN, color)
    return replace(panel, texture=panel.vertices - panel.vertices.mean(axis=0))


def lights(
    body: ColoredMesh, end: float, widths: tuple[float, float], heights: tuple[float, float]
) -> list[ColoredMesh]:
    """A pair of lights on the convex `body` that ends at x = `end`: headlights at the front, tail lights at the rear.
    They cover |y| in `widths` and z in `heights`."""
    sign, color = np.sign(end), HEADLIGHT if end > 0 else TAIL_LIGHT
    a, b, c = (body.triangles[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    faces = sign * normal[:, 0] > 1e-9
    normal, offset = normal[faces], (normal * a).sum(axis=1)[faces]
    rim = []
    for y in np.linspace(*widths, 3):
        for z in np.linspace(*heights, 3):
            depth = sign * (offset - normal[:, 1] * y - normal[:, 2] * z) / normal[:, 0]
            x = min(depth.min() + 0.012, abs(end))
            rim += [(sign * x, y, z), (sign * (x - 0.1), y, z)]
    return [hull([(x, side * y, z) for x, y, z in rim], Material.LAMP, color) for side in (-1, 1)]


def plates(front: float, z: float) -> list[ColoredMesh]:
    """Number plates at both ends."""
    return [
        box((x - 0.012, -0.26, z), (x + 0.012, 0.26, z + 0.11), Material.PLAIN, PLATE)
        for x in (-front + 0.012, front - 0.012)
    ]


def wing_mirrors(x: float, half_width: float, z: float, size: float, color: Color) -> list[ColoredMesh]:
    """Mirrors on both sides, between the body and y = +-`half_width`, `size` metres high."""
    parts = []
    for side in (-1, 1):
        y0, y1 = sorted((side * (half_width - 0.22), side * half_width))
        parts.append(box((x, y0, z), (x + 0.1, y1, z + size), Material.PAINT, color))
        parts.append(
            box((x - 0.008, y0 + 0.015, z + 0.02), (x, y1 - 0.015, z + size - 0.02), Material.METAL, (0.4, 0.45, 0.5))
        )
    return parts
