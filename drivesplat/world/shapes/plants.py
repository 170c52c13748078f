"""Trees, hedges and planters. Leaves are single triangles, seen from both sides, around darker cores."""

import numpy as np
import trimesh

from drivesplat.world.shapes.mesh import (
    BARK,
    Color,
    ColoredMesh,
    Material,
    Numbers,
    SurfaceClass,
    box,
    concatenate,
    uniform,
)

SOIL, CONCRETE = (0.06, 0.045, 0.03), (0.4, 0.39, 0.37)
BLOSSOMS: tuple[Color, ...] = ((0.6, 0.08, 0.12), (0.7, 0.55, 0.08), (0.45, 0.2, 0.5), (0.7, 0.68, 0.65))


def tree(height: float, random: np.random.Generator, overhang: float = 0.0) -> ColoredMesh:
    """A tree whose crown reaches `overhang` metres farther along y (negative: against y), over the road for instance.
    The lowest leaves hang at about 0.4 of the height."""
    radius = 0.028 * height
    fork = np.array([0.0, 0.15 * overhang, 0.42 * height])
    limbs = [_limb((0.0, 0.0, 0.0), fork, radius, 0.75 * radius)]
    clusters, first = [], random.uniform(0, 2 * np.pi)
    for k in range(3):
        angle = first + 2.1 * k
        reach = 0.17 * height * random.uniform(0.8, 1.2)
        side = reach * np.sin(angle) + 0.7 * overhang
        end = fork + np.array([reach * np.cos(angle), side, height * random.uniform(0.2, 0.3)])
        limbs.append(_limb(fork - (0, 0, 0.03 * height), end, 0.55 * radius, 0.25 * radius))
        clusters += [end, (end + fork) / 2 + (*random.uniform(-0.1, 0.1, 2) * height, 0.16 * height)]
    clusters.append(fork + np.array([0.0, 0.35 * overhang, 0.42 * height]))
    color = (random.uniform(0.06, 0.11), random.uniform(0.16, 0.23), random.uniform(0.03, 0.05))
    leaves = [
        _cluster(center, random.uniform(0.12, 0.17, 3) * height, 165, 0.05 * height**0.5, color, random)
        for center in clusters
    ]
    return concatenate([*limbs, *leaves]).classified(SurfaceClass.VEGETATION)


def hedge(length: float, height: float, depth: float, random: np.random.Generator) -> ColoredMesh:
    """A clipped hedge along x."""
    core = trimesh.creation.box(bounds=[(-length / 2, -depth / 2, 0.0), (length / 2, depth / 2, height - 0.03)])
    color = (random.uniform(0.04, 0.07), random.uniform(0.11, 0.16), random.uniform(0.02, 0.04))
    sizes = np.array([length * height, length * height, length * depth, depth * height, depth * height])
    face = random.choice(5, int(90 * sizes.sum()), p=sizes / sizes.sum())
    at = random.uniform(-0.5, 0.5, (len(face), 3)) * (length, depth, height) + (0.0, 0.0, height / 2)
    normals = np.array([(0, -1, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (1, 0, 0)], dtype=float)[face]
    limits = np.where(normals > 0, 1.0, 0.0) * (length / 2, depth / 2, height)
    limits -= np.where(normals < 0, 1.0, 0.0) * (length / 2, depth / 2, 0.0)
    at = np.where(normals != 0, limits, at)
    dark = uniform(core, Material.LEAVES, tuple(0.75 * c for c in color))
    return concatenate([dark, _leaves(at, normals, 0.09, color, random, lowest=0.0)]).classified(
        SurfaceClass.VEGETATION
    )


def planter(random: np.random.Generator) -> ColoredMesh:
    """A concrete tub with flowers, 1.2 m long."""
    blossom = BLOSSOMS[random.integers(len(BLOSSOMS))]
    tub = box((-0.6, -0.25, 0.0), (0.6, 0.25, 0.45), Material.PLAIN, CONCRETE).classified(SurfaceClass.OBJECT)
    soil = box((-0.55, -0.2, 0.4), (0.55, 0.2, 0.47), Material.PLAIN, SOIL).classified(SurfaceClass.OBJECT)
    plants = []
    for x in np.linspace(-0.42, 0.42, 4):
        plants.append(_cluster((x, 0.0, 0.56), (0.2, 0.2, 0.16), 30, 0.05, (0.07, 0.18, 0.04), random, lowest=0.45))
        at = random.uniform(-0.15, 0.15, (10, 3)) * (1, 1, 0.5) + (x, 0.0, 0.7)
        plants.append(_leaves(at, np.tile([0.0, 0.0, 1.0], (10, 1)), 0.05, blossom, random))
    return concatenate([tub, soil, concatenate(plants).classified(SurfaceClass.VEGETATION)])


def _limb(start: Numbers, end: Numbers, start_radius: float, end_radius: float) -> ColoredMesh:
    """A trunk or branch that tapers from `start` to `end`."""
    mesh = trimesh.creation.cylinder(1.0, segment=[start, end], sections=8)
    axis = np.subtract(end, start)
    share = ((mesh.vertices - start) @ axis) / (axis @ axis)
    center = np.asarray(start) + share[:, None] * axis
    radius = start_radius + share * (end_radius - start_radius)
    mesh.vertices = center + radius[:, None] * (mesh.vertices - center)
    mesh.vertices[:, 2] = np.maximum(mesh.vertices[:, 2], 0.0)
    return uniform(mesh, Material.PLAIN, BARK)


def _cluster(
    center: Numbers,
    radii: Numbers,
    count: int,
    size: float,
    color: Color,
    random: np.random.Generator,
    lowest: float = 0.5,
) -> ColoredMesh:
    """Leaves around an ellipsoid."""
    core = trimesh.creation.icosphere(subdivisions=0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    at = np.asarray(center) + directions * radii * random.uniform(0.8, 1.25, (count, 1))
    core.vertices = np.asarray(center) + core.vertices * radii * random.uniform(0.8, 1.0, (len(core.vertices), 1))
    core.vertices[:, 2] = np.maximum(core.vertices[:, 2], lowest)
    dark = uniform(core, Material.LEAVES, tuple(0.6 * c for c in color))
    return concatenate([dark, _leaves(at, directions, size, color, random, lowest)])


def _leaves(
    at: np.ndarray, normals: np.ndarray, size: float, color: Color, random: np.random.Generator, lowest: float = -np.inf
) -> ColoredMesh:
    """A triangle about `size` metres long at each of the points (n, 3), roughly square to the normals (n, 3)."""
    count = len(at)
    normals = normals + random.normal(scale=0.5, size=(count, 3))
    along = np.cross(normals, random.normal(size=(count, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normals, along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    length = size * random.uniform(0.7, 1.5, (count, 1))
    corners = np.stack([at - length * along, at + length * (0.5 * along - across), at + length * (along + across)], 1)
    corners[..., 2] = np.maximum(corners[..., 2], lowest)
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), process=False)
    tones = uniform(mesh, Material.LEAVES, color)
    tones.color[:] *= random.uniform(0.7, 1.3, (count, 1))
    return tones
