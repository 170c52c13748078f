"""Colored triangle meshes for the objects of a street.

Each stands on z = 0 in its own frame: metres, x forward, y left, z up. Primitives are trimesh's; vehicles are convex
hulls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation


class Material(IntEnum):
    """Surface type; drivesplat/demo/materials.py has the textures."""

    PLAIN = 0
    ROAD = 1
    FACADE = 2
    LEAVES = 3
    PAINT = 4
    GLASS = 5
    LAMP = 6
    CLOTH = 7
    STRIPES = 8


Color = tuple[float, float, float]
"""Linear reflectance in [0, 1]."""
Numbers = Sequence[float | int] | np.ndarray
TYRE, METAL, BARK, SKIN = (0.03, 0.03, 0.035), (0.35, 0.36, 0.38), (0.16, 0.11, 0.07), (0.62, 0.42, 0.32)
TAIL_LIGHT, HEADLIGHT, WINDSCREEN = (0.75, 0.05, 0.04), (0.95, 0.95, 0.85), (0.02, 0.025, 0.03)


@dataclass(frozen=True)
class ColoredMesh:
    """`vertices` (v, 3) metres, `faces` (f, 3) counter-clockwise seen from outside, `material` (f,), `color` (f, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    color: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """Corners (f, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def size(self) -> np.ndarray:
        """Length, width and height (3,) of the smallest upright box around it with its centre at x = y = 0."""
        return np.array([*(2.0 * np.abs(self.vertices[:, :2]).max(axis=0)), self.vertices[:, 2].max()])

    def moved(self, translation: Numbers, yaw: float = 0.0) -> "ColoredMesh":
        """The mesh rotated by `yaw` radians about z, then translated."""
        rotated = self.vertices @ Rotation.from_euler("z", yaw).as_matrix().T
        return replace(self, vertices=rotated + np.array(translation))


def concatenate(meshes: Sequence[ColoredMesh]) -> ColoredMesh:
    """One mesh of several."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return ColoredMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
        np.concatenate([mesh.color for mesh in meshes]),
    )


def _uniform(mesh: trimesh.Trimesh, material: Material, color: Color) -> ColoredMesh:
    """A mesh of one material and colour."""
    faces = np.asarray(mesh.faces, dtype=np.int64)
    colors = np.tile(np.array(color, dtype=np.float64), (len(faces), 1))
    return ColoredMesh(np.asarray(mesh.vertices, dtype=np.float64), faces, np.full(len(faces), int(material)), colors)


def box(low: Numbers, high: Numbers, material: Material, color: Color) -> ColoredMesh:
    """The axis-aligned box between two corners."""
    return _uniform(trimesh.creation.box(bounds=[low, high]), material, color)


def cylinder(start: Numbers, end: Numbers, radius: float, material: Material, color: Color) -> ColoredMesh:
    """The cylinder between two points."""
    mesh = trimesh.creation.cylinder(radius, segment=[start, end], sections=14)
    return _uniform(mesh, material, color)


def ellipsoid(center: Numbers, radii: Numbers, material: Material, color: Color) -> ColoredMesh:
    """The ellipsoid with semi-axes `radii` along x, y, z."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale(radii)
    mesh.apply_translation(center)
    return _uniform(mesh, material, color)


def hull(points: Sequence[Numbers], material: Material, color: Color) -> ColoredMesh:
    """The convex hull of points."""
    return _uniform(trimesh.convex.convex_hull(np.array(points)), material, color)


def _profile(sections: Sequence[tuple[float, float, float]], material: Material, color: Color) -> ColoredMesh:
    """The convex hull of a symmetric profile: x, z and half the width at each corner."""
    return hull([(x, side * y, z) for x, z, y in sections for side in (-1, 1)], material, color)


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
        _profile(lower, Material.PAINT, color),
        _profile(glass, Material.GLASS, WINDSCREEN),
        _profile(roof, Material.PAINT, color),
    ]
    return concatenate([*parts, *_wheels(size, 0.32 * length), *_lights(size, 0.62 * belt)])


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
    parts = [cargo, _profile(cab, Material.PAINT, color), _profile(screen, Material.GLASS, WINDSCREEN)]
    return concatenate([*parts, *_wheels(size, 0.33 * length), *_lights(size, 0.38 * height)])


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


def pedestrian(height: float, shirt: Color, trousers: Color, stride: float) -> ColoredMesh:
    """A walking person. `stride` in [-1, 1]: 1 puts the right leg forward."""
    hip, shoulder, swing = 0.52 * height, 0.8 * height, 0.3 * stride
    parts = [
        ellipsoid((0.0, 0.0, 0.93 * height), (0.1, 0.09, 0.07 * height), Material.PLAIN, SKIN),
        hull(
            [(x, side * y, z) for x in (-0.11, 0.11) for side in (-1, 1) for y, z in ((0.17, hip), (0.22, shoulder))],
            Material.CLOTH, shirt,
        ),
    ]  # fmt: skip
    for side in (-1, 1):
        step = -side * swing
        parts.append(cylinder((0, side * 0.1, hip), (step, side * 0.1, 0.0), 0.08, Material.CLOTH, trousers))
        hand = (-0.8 * step, side * 0.27, hip)
        parts.append(cylinder((0, side * 0.24, shoulder), hand, 0.05, Material.CLOTH, shirt))
    mesh = concatenate(parts)
    return mesh.moved((0.0, 0.0, -min(0.0, mesh.vertices[:, 2].min())))


def tree(height: float, rng: np.random.Generator) -> ColoredMesh:
    """A trunk, and a crown of five ellipsoids."""
    crown = [
        ellipsoid(
            (*rng.uniform(-0.17, 0.17, 2) * height, height * rng.uniform(0.62, 0.85)),
            rng.uniform(0.15, 0.25, 3) * height, Material.LEAVES,
            (rng.uniform(0.06, 0.12), rng.uniform(0.16, 0.24), rng.uniform(0.03, 0.06)),
        )
        for _ in range(5)
    ]  # fmt: skip
    return concatenate([cylinder((0, 0, 0), (0, 0, 0.65 * height), 0.035 * height, Material.PLAIN, BARK), *crown])


def building(low: Numbers, high: Numbers, color: Color) -> ColoredMesh:
    """A building between two corners, with a flat roof."""
    x0, y0, z1 = low[0], low[1], high[2]
    roof = box((x0 - 0.3, y0 - 0.3, z1), (high[0] + 0.3, high[1] + 0.3, z1 + 0.4), Material.PLAIN, METAL)
    return concatenate([box(low, high, Material.FACADE, color), roof])


def street_lamp(height: float, arm: float) -> ColoredMesh:
    """A pole with a lamp at the end of an arm of length `arm` along y."""
    pole = cylinder((0, 0, 0), (0, 0, height), 0.08, Material.PLAIN, METAL)
    bar = cylinder((0, 0, height), (0, arm, height + 0.2), 0.05, Material.PLAIN, METAL)
    lamp = box((-0.15, arm - 0.3, height + 0.1), (0.15, arm + 0.3, height + 0.2), Material.LAMP, HEADLIGHT)
    return concatenate([pole, bar, lamp])


def sign(color: Color) -> ColoredMesh:
    """A traffic sign facing -x."""
    disc = cylinder((-0.05, 0, 2.4), (-0.03, 0, 2.4), 0.32, Material.PLAIN, color)
    face = cylinder((-0.07, 0, 2.4), (-0.05, 0, 2.4), 0.24, Material.PLAIN, (0.8, 0.8, 0.8))
    return concatenate([cylinder((0, 0, 0), (0, 0, 2.7), 0.03, Material.PLAIN, METAL), disc, face])


def cone() -> ColoredMesh:
    """A traffic cone."""
    mesh = trimesh.creation.cone(0.17, 0.7, sections=16)
    base = box((-0.2, -0.2, 0), (0.2, 0.2, 0.04), Material.PLAIN, TYRE)
    return concatenate([base, _uniform(mesh, Material.STRIPES, (0.8, 0.25, 0.03))])
