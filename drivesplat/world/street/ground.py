"""The ground: road, curbs, sidewalks and grass, as strips along the road."""

import numpy as np

from drivesplat.world.layout import CURB, ROAD, SIDEWALK
from drivesplat.world.shapes.mesh import ColoredMesh, Material, SurfaceClass
from drivesplat.world.street.road import ReferenceLine

NEAR = (-120.0, 300.0)
"""First and last s (metres) of the street proper."""
FAR = 600.0
"""Metres to which the ground extends."""
CELL = 3.0
"""Length of a cell of the ground (metres) where the road is not straight; without that, 30."""
CURB_HEIGHT = 0.1


def ground(road: ReferenceLine) -> list[ColoredMesh]:
    """The strips of the ground and the two curbs."""
    # within the bend's centre no strip may reach: there s, t would be ambiguous
    inner = np.inf if road.is_straight else 0.8 * abs(road.radius)
    aside = min(FAR, inner)
    strips = [
        _strip(road, -ROAD, ROAD, SurfaceClass.ROAD),
        *(_strip(road, *sorted((side * ROAD, side * SIDEWALK)), SurfaceClass.SIDEWALK) for side in (-1, 1)),
        *(_strip(road, *sorted((side * SIDEWALK, side * aside)), SurfaceClass.TERRAIN) for side in (-1, 1)),
    ]
    cell = 30.0 if road.is_straight else CELL
    along = np.arange(NEAR[0], NEAR[1] + cell, cell)
    first = (np.arange(len(along) - 1)[:, None] * 4 + np.arange(3)).ravel()
    corners = np.stack([first, first + 4, first + 5, first + 1], axis=-1)
    faces = np.concatenate([corners[:, [0, 2, 1]], corners[:, [0, 3, 2]]])
    for side in (-1, 1):  # the kerb stones beside the road, which stand out of it
        low, high = sorted((side * ROAD, side * CURB))
        profile = np.array([(low, -0.02), (low, CURB_HEIGHT), (high, CURB_HEIGHT), (high, -0.02)])
        points = np.array([(s, t, h) for s in along for t, h in profile])
        strips.append(road.follow(_mesh(points, faces, SurfaceClass.SIDEWALK)))
    return strips


def _strip(road: ReferenceLine, right: float, left: float, surface_class: SurfaceClass) -> ColoredMesh:
    """The ground between two offsets from the centre line."""
    cell = 30.0 if road.is_straight else CELL
    near = np.arange(NEAR[0], NEAR[1] + cell, cell)
    along = np.concatenate([[-FAR], near, [near[-1] + FAR]])
    across = np.unique(np.concatenate([[right, left], np.arange(np.ceil(right / 8) * 8, left, 8.0)]))
    across = across[(np.abs(across) <= 40.0) | (across == right) | (across == left)]
    s, t = np.meshgrid(along, across, indexing="ij")
    flat = np.stack([s, t, np.zeros_like(s)], axis=-1).reshape(-1, 3)
    rows, columns = len(along), len(across)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    corners = np.stack([first, first + columns, first + columns + 1, first + 1], axis=-1)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return road.follow(_mesh(flat, faces, surface_class))


def _mesh(points: np.ndarray, faces: np.ndarray, surface_class: SurfaceClass) -> ColoredMesh:
    count = len(faces)
    return ColoredMesh(
        points, points, faces, np.full(count, int(Material.ROAD)), np.full((count, 3), 0.1),
        np.full(count, int(surface_class)),
    )  # fmt: skip
