"""Seed points beyond the range of LiDAR, along the rays of pixels that no other seed point covers."""

import numpy as np

from drivesplat.lidar.coloring import ColorView, in_image

COVERAGE_CELL = 8
"""Edge length in pixels of the image cell that a seed point covers."""


def uncovered(view: ColorView, points: np.ndarray) -> np.ndarray:
    """Flat row-major indices (m,) of a view's usable pixels in cells of COVERAGE_CELL pixels into which none of the
    world points (n, 3) projects."""
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
    """At most `count` random points on the rays of pixels drawn from `candidates`, which `uncovered` returns.

    Depth is log-uniform between `depths` (metres). A point below the ground plane at height `ground_z` is moved along
    its ray onto the plane. Returns world positions (m, 3) and the colours (m, 3) uint8 of the pixels.
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
