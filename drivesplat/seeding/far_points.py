"""Seed points for what LiDAR does not reach: along pixels that no seed point covers."""

import numpy as np

from drivesplat.images import project
from drivesplat.seeding.coloring import ColorView

COVERAGE_CELL = 8
"""Edge in pixels of the cells that a seed point covers."""


def far_points(
    view: ColorView,
    ground_z: float,
    covered: np.ndarray,
    count: int,
    depths: tuple[float, float],
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """`count` random points (at most) in the view's frustum, through pixels that `covered` (n, 3) world points leave
    empty.

    Depth is log-uniform between `depths` (metres); a point that would lie under the ground plane at height `ground_z`
    is moved up its ray onto it. Returns positions (m, 3) and the colours (m, 3) of their pixels.
    """
    height, width = view.pixels.shape[:2]
    free = ~np.kron(_coverage(view, covered), np.ones((COVERAGE_CELL, COVERAGE_CELL), dtype=bool))[:height, :width]
    candidates = np.flatnonzero(free & view.usable)
    chosen = random.choice(candidates, size=min(count, len(candidates)), replace=False)
    rows, columns = np.divmod(chosen, width)
    camera_to_world = np.linalg.inv(view.world_to_camera)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    rays = pixels @ np.linalg.inv(view.intrinsics).T @ camera_to_world[:3, :3].T
    center = camera_to_world[:3, 3]
    depth = np.exp(random.uniform(*np.log(depths), size=len(rows)))
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, (ground_z - center[2]) / rays[:, 2], np.inf)
    depth = np.minimum(depth, np.where(to_ground > 0, to_ground, np.inf))
    return center + depth[:, None] * rays, view.pixels[rows, columns]


def _coverage(view: ColorView, covered: np.ndarray) -> np.ndarray:
    height, width = view.pixels.shape[:2]
    cells = np.zeros((height // COVERAGE_CELL + 1, width // COVERAGE_CELL + 1), dtype=bool)
    pixels, depth = project(covered, view.world_to_camera, view.intrinsics)
    ahead = (depth > 0.5) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    columns, rows = (pixels[ahead] // COVERAGE_CELL).astype(np.int64).T
    cells[rows, columns] = True
    return cells
