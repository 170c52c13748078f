"""Limbs: lofted meshes, poses of links between joints, and two-link inverse kinematics."""

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drivesplat.world.shapes.mesh import Color, ColoredMesh, Material, uniform
from drivesplat.world.shapes.vectors import cross

Ring = tuple[float, float, float, float]
"""A horizontal ellipse with its centre at y = 0: z, x of the centre, semi-axis along x, semi-axis along y (metres)."""


def loft(rings: Sequence[Ring], material: Material, color: Color, sides: int = 10) -> ColoredMesh:
    """The closed surface through ellipses."""
    z, x, depth, width = np.array(sorted(rings), dtype=np.float64).T[..., None]
    angles = 2.0 * np.pi * np.arange(sides) / sides
    points = np.stack(np.broadcast_arrays(x + depth * np.cos(angles), width * np.sin(angles), z), axis=-1)
    count = len(rings) * sides
    indices = np.arange(count).reshape(-1, sides)
    following = np.roll(indices, -1, axis=1)
    low, next_low, high, next_high = indices[:-1], following[:-1], indices[1:], following[1:]
    faces = [
        np.stack([low, next_low, next_high], axis=-1).reshape(-1, 3),
        np.stack([low, next_high, high], axis=-1).reshape(-1, 3),
        np.stack([np.full(sides, count), following[0], indices[0]], axis=-1),
        np.stack([np.full(sides, count + 1), indices[-1], following[-1]], axis=-1),
    ]
    vertices = np.concatenate([points.reshape(-1, 3), points[[0, -1]].mean(axis=1)])
    return uniform(trimesh.Trimesh(vertices, np.concatenate(faces), process=False), material, color)


def limb(length: float, radii: Sequence[float], material: Material, color: Color) -> ColoredMesh:
    """A link that hangs from the origin down to z = -length, with radii at equal distances and rounded ends."""
    heights = -length * np.linspace(0.0, 1.0, len(radii))
    ends = [(0.7 * radii[0], 0.7 * radii[0]), (-length - 0.7 * radii[-1], 0.7 * radii[-1])]
    rings = [(z, 0.0, radius, radius) for z, radius in [*zip(heights, radii, strict=True), *ends]]
    return loft(rings, material, color, 8)


def two_link(root: np.ndarray, end: np.ndarray, lengths: tuple[float, float], bend: np.ndarray) -> np.ndarray:
    """The middle joint (..., 3) of two links from `root` to `end` (..., 3), displaced towards `bend` (..., 3).

    The law of cosines gives it. Raises ValueError where the links cannot reach.
    """
    upper, lower = lengths
    span = end - root
    distance = np.linalg.norm(span, axis=-1, keepdims=True)
    if np.any(distance > upper + lower) or np.any(distance < abs(upper - lower)):
        raise ValueError(
            f"Links of {upper:.3f} m and {lower:.3f} m cannot span {distance.min():.3f} to {distance.max():.3f} m; "
            "bring the joints closer to each other or lengthen the links."
        )
    along = (distance**2 + upper**2 - lower**2) / (2.0 * distance)
    axis = span / distance
    across = bend - axis * (bend * axis).sum(axis=-1, keepdims=True)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return root + along * axis + np.sqrt(np.maximum(upper**2 - along**2, 0.0)) * across


def links(start: np.ndarray, end: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) of links that hang from `start` to `end` (..., 3): their z axes point from end to start, their
    y axes as nearly to `left` (..., 3) as possible."""
    z = start - end
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    x = cross(np.broadcast_to(left, z.shape), z)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return transforms(np.stack([x, cross(z, x), z], axis=-1), start)


def transforms(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """The 4x4 transforms (..., 4, 4) of rotation matrices (..., 3, 3) and translations (..., 3)."""
    poses = np.zeros((*translations.shape[:-1], 4, 4))
    poses[..., :3, :3], poses[..., :3, 3], poses[..., 3, 3] = rotations, translations, 1.0
    return poses


def oriented(translations: np.ndarray, yaw: np.ndarray | float = 0.0, pitch: np.ndarray | float = 0.0) -> np.ndarray:
    """The transforms (n, 4, 4) of translations (n, 3) and angles (n,) in radians. A positive pitch lowers the front."""
    angles = np.stack(np.broadcast_arrays(yaw, pitch, np.zeros(len(translations))), axis=-1)
    return transforms(Rotation.from_euler("ZYX", angles).as_matrix(), translations)


def pitched(vector: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """A vector (2,) of x and z at each pitch (...) in radians: (..., 2)."""
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([cosine * vector[0] + sine * vector[1], cosine * vector[1] - sine * vector[0]], axis=-1)


def placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (k, 3) of a piece at each of its poses (n, 4, 4): (n, k, 3)."""
    return np.einsum("nij,kj->nki", poses[:, :3, :3], points) + poses[:, None, :3, 3]


def mean_size(poses: np.ndarray, pieces: Sequence[ColoredMesh], share: float = 0.9) -> np.ndarray:
    """The annotated size (3,) of a figure over its cycle (n, pieces, 4, 4).

    The height is the greatest. Length and width are means over the cycle of the smallest intervals, symmetric about the
    object's centre, that contain `share` of the surface's area: a foot at the end of its swing may be outside, as in
    annotated boxes, which keep one size for a whole track.
    """
    corners = [placed(poses[:, i], mesh.vertices)[:, mesh.faces] for i, mesh in enumerate(pieces)]
    triangles = np.concatenate(corners, axis=1)
    first, second, third = np.moveaxis(triangles[0], 1, 0)
    areas = np.linalg.norm(cross(second - first, third - first), axis=-1)
    offsets = np.abs(triangles.mean(axis=2)[..., :2])
    order = np.argsort(offsets, axis=1)
    inside = np.cumsum(areas[order], axis=1) < share * areas.sum()
    extents = 2.0 * np.where(inside, np.take_along_axis(offsets, order, axis=1), 0.0).max(axis=1)
    return np.array([*extents.mean(axis=0), triangles[..., 2].max()])
