"""Coloured triangle meshes and the primitives they are made of.

Meshes are in the frame of their object: metres, x forward, y left, z up, the ground at z = 0. Primitives are trimesh's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import apply


class Material(IntEnum):
    """How a surface looks to cameras and to the LiDAR; drivesplat/world/optics/materials.py has the textures."""

    PLAIN = 0
    ROAD = 1
    FACADE = 2
    LEAVES = 3
    PAINT = 4
    GLASS = 5
    LAMP = 6
    CLOTH = 7
    STRIPES = 8
    METAL = 9
    SIGN = 10


class SurfaceClass(IntEnum):
    """What a surface belongs to: the values of class maps."""

    ROAD = 0
    SIDEWALK = 1
    TERRAIN = 2
    BUILDING = 3
    FENCE = 4
    VEGETATION = 5
    POLE = 6
    SIGN = 7
    VEHICLE = 8
    PERSON = 9
    CYCLIST = 10
    ANIMAL = 11
    OBJECT = 12
    SKY = 13
    MARKING = 14
    """Paint on the road. Only true images tell it from ROAD."""


GAMMA = 2.2
"""Exponent of the encoding of images."""
Color = tuple[float, float, float]
"""Linear reflectance in [0, 1]."""
Numbers = Sequence[float | int] | np.ndarray
TYRE, METAL, BARK, SKIN = (0.03, 0.03, 0.035), (0.35, 0.36, 0.38), (0.16, 0.11, 0.07), (0.62, 0.42, 0.32)


@dataclass(frozen=True)
class ColoredMesh:
    """`vertices` (v, 3) metres; `texture` (v, 3) metres, the positions at which procedural textures are evaluated;
    `faces` (f, 3) counter-clockwise seen from outside; `material` (f,); `color` (f, 3); `surface_class` (f,)."""

    vertices: np.ndarray
    texture: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    color: np.ndarray
    surface_class: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """Corners (f, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def size(self) -> np.ndarray:
        """Length, width and height (3,) of the smallest upright box around it with its centre at x = y = 0."""
        return np.array([*(2.0 * np.abs(self.vertices[:, :2]).max(axis=0)), self.vertices[:, 2].max()])

    def moved(self, translation: Numbers, yaw: float = 0.0) -> "ColoredMesh":
        """The mesh rotated by `yaw` radians about z, then translated; the texture stays on it."""
        rotated = self.vertices @ Rotation.from_euler("z", yaw).as_matrix().T
        return replace(self, vertices=rotated + np.array(translation))

    def transformed(self, pose: np.ndarray) -> "ColoredMesh":
        """The mesh moved by a rigid transform (4, 4); the texture stays on it."""
        return replace(self, vertices=apply(pose, self.vertices))

    def scaled(self, factor: float) -> "ColoredMesh":
        """The mesh scaled about the origin; the texture is not."""
        return replace(self, vertices=factor * self.vertices)

    def recolored(self, matrix: np.ndarray) -> "ColoredMesh":
        """The mesh with all colours mapped by a matrix (3, 3) of colours as images encode them: light scales encoded
        colours, too, so that images of the mesh are mapped likewise, apart from mirrored sky and lamps."""
        encoded = (self.color ** (1 / GAMMA)) @ matrix.T
        return replace(self, color=np.clip(encoded, 0.0, 1.0) ** GAMMA)

    def classified(self, surface_class: SurfaceClass) -> "ColoredMesh":
        """The mesh with one class for all faces."""
        return replace(self, surface_class=np.full(len(self.faces), int(surface_class)))


def concatenate(meshes: Sequence[ColoredMesh]) -> ColoredMesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)])
    rows = [np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("vertices", "texture")]
    attributes = [np.concatenate([getattr(m, name) for m in meshes]) for name in ("material", "color", "surface_class")]
    return ColoredMesh(*rows, faces, *attributes)


def uniform(
    mesh: trimesh.Trimesh, material: Material, color: Color, surface_class: SurfaceClass = SurfaceClass.OBJECT
) -> ColoredMesh:
    """A mesh of one material, colour and class."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    colors = np.tile(np.array(color, dtype=np.float64), (len(faces), 1))
    classes = np.full(len(faces), int(surface_class))
    return ColoredMesh(vertices, vertices, faces, np.full(len(faces), int(material)), colors, classes)


def box(low: Numbers, high: Numbers, material: Material, color: Color) -> ColoredMesh:
    """The axis-aligned box between two corners."""
    unit = _unit_box()
    start, extent = np.array(low, dtype=np.float64), np.subtract(high, low)
    vertices, count = start + unit.vertices * extent, len(unit.faces)
    return replace(
        unit,
        vertices=vertices,
        texture=vertices,
        material=np.full(count, int(material)),
        color=np.tile(np.array(color, dtype=np.float64), (count, 1)),
    )


@cache
def _unit_box() -> ColoredMesh:
    """The box from the origin to (1, 1, 1); thousands of boxes are made of it."""
    return uniform(trimesh.creation.box(bounds=[(0, 0, 0), (1, 1, 1)]), Material.PLAIN, (0.0, 0.0, 0.0))


def cylinder(start: Numbers, end: Numbers, radius: float, material: Material, color: Color) -> ColoredMesh:
    """The cylinder between two points."""
    return uniform(trimesh.creation.cylinder(radius, segment=[start, end], sections=14), material, color)


def ellipsoid(center: Numbers, radii: Numbers, material: Material, color: Color) -> ColoredMesh:
    """The ellipsoid with semi-axes `radii` along x, y, z."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale(radii)
    mesh.apply_translation(center)
    return uniform(mesh, material, color)


def torus(center: Numbers, radius: float, thickness: float, material: Material, color: Color) -> ColoredMesh:
    """A torus about the y axis through `center`: a wheel's tyre."""
    mesh = trimesh.creation.torus(radius, thickness, major_sections=24, minor_sections=8)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    mesh.apply_translation(center)
    return uniform(mesh, material, color)


def hull(points: Sequence[Numbers], material: Material, color: Color) -> ColoredMesh:
    return uniform(trimesh.convex.convex_hull(np.array(points)), material, color)


def symmetric_hull(sections: Sequence[tuple[float, float, float]], material: Material, color: Color) -> ColoredMesh:
    """The convex hull of a profile: x, z and half the width at each corner."""
    return hull([(x, side * y, z) for x, z, y in sections for side in (-1, 1)], material, color)
