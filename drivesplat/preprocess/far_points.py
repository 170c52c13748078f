"""Seed points for what LiDAR does not reach: along pixels that no seed point covers."""

import numpy as np

from drivesplat.lidar.coloring import ColorView, in_image

COVERAGE_CELL = 8
"""Edge in pixels of the cells that a seed point covers."""


def uncovered(view: ColorView, points: np.ndarray) -> np.ndarray:
    """The usable pixels of a view, as indices (m,) of its pixels row by row, in whose cells of COVERAGE_CELL pixels
    none of the world points (n, 3) lies."""
    height, width = view.pixels.shape[:2]
    cells = np.zeros((height // COVERAGE_CELL + 1, width // COVERAGE_CELL + 1), dtype=bool)
    _, rows, columns, _ = in_image(points, view.world_to_camera, view.intrinsics, (height, width))
    cells[rows // COVERAGE_CELL, columns // COVERAGE_CELL] = True
    covered = cells.repeat(COVERAGE_CELL, axis=0).repeat(COVERAGE_CELL, axis=1)[:height, :width]
    return np.flatnonzero(view.usable & ~covered)


def far_points(
    view: ColorView,
    ground_z: float,
    candidates: np.ndarray,
    count: int,
    depths: tuple[float, float],
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """`count` random points (at most) in the view's frustum, through pixels among the `candidates` (m,), as `uncovered`
    gives them.

    Depth is log-uniform between `depths` (metres); a point that would lie under the ground plane at height `ground_z`
    is moved up its ray onto it. Returns positions (m, 3) and the colours (m, 3) of their pixels.
    """
    chosen = random.choice(candidates, size=min(count, len(candidates)), replace=False)
    rows, columns = np.divmod(chosen, view.pixels.shape[1])
    camera_to_world = np.linalg.inv(view.world_to_camera)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    rays = pixels @ np.linalg.inv(view.intrinsics).T @ camera_to_world[:3, :3].T
    center = camera_to_world[:3, 3]
    depth = np.exp(random.uniform(*np.log(depths), size=len(rows)))
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, (ground_z - center[2]) / rays[:, 2], np.inf)
    depth = np.minimum(depth, np.where(to_ground > 0, to_ground, np.inf))
    return center + depth[:, None] * rays, view.pixels[rows, columns]
