"""Colours for points from the images that see them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drivesplat.io.prefetch import prefetch


@dataclass(frozen=True)
class ColorView:
    """An image that may colour points: `pixels` (h, w, 3) uint8, `usable` (h, w) bool, `intrinsics` continuous."""

    pixels: np.ndarray
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    timestamp: int
    usable: np.ndarray


CELL = 4
"""Edge in pixels of the cells of the depth buffer that decides occlusion: LiDAR is sparser than the image."""
NEAREST = 0.5
"""Depth in metres up to which nothing is seen."""
OCCLUSION = 1.05
"""A point is hidden where something in its cell is nearer by this factor and half a metre."""


def hidden_behind(depth: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """Whether what is at `depth` (m,) metres is hidden where something is seen at `nearest` (m,): (m,) bool."""
    return depth > nearest * OCCLUSION + 0.5


def color_by_visibility(
    points: np.ndarray, times: np.ndarray, views: Iterable[ColorView]
) -> tuple[np.ndarray, np.ndarray]:
    """Each point's colour in the view nearest to it in time among those that see it unoccluded.

    `points` (n, 3) world; `times` (n,) microseconds. Returns colours (n, 3) uint8 and the number of views that see each
    point (n,): where it is 0 the colour is meaningless.
    """

    def seen_by(view: ColorView) -> tuple[np.ndarray, np.ndarray, int]:
        """The points that a view sees, their colours in it, and its time."""
        index, rows, columns, _ = visible(points, view.world_to_camera, view.intrinsics, view.pixels.shape[:2])
        usable = view.usable[rows, columns]
        return index[usable], view.pixels[rows[usable], columns[usable]], view.timestamp

    colors = np.zeros((len(points), 3), dtype=np.uint8)
    best = np.full(len(points), np.inf)
    seen = np.zeros(len(points), dtype=np.int64)
    for index, in_view, timestamp in prefetch(seen_by, views):
        seen[index] += 1
        distance = np.abs(times[index] - timestamp)
        better = distance < best[index]
        best[index[better]] = distance[better]
        colors[index[better]] = in_view[better]
    return colors, seen


def visible(
    points: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (m,), pixel rows (m,) and columns (m,), and depths (m,) along the axis in metres, of the points (n, 3)
    that an image of `shape` (h, w) sees.

    A point is hidden where another of the points, in the same cell of CELL pixels, stands clearly before it.
    """
    index, rows, columns, depth = in_image(points, world_to_camera, intrinsics, shape)
    height, width = shape
    cells = (rows // CELL) * (width // CELL + 1) + columns // CELL
    nearest = np.full((height // CELL + 1) * (width // CELL + 1), np.inf)
    np.minimum.at(nearest, cells, depth)
    front = ~hidden_behind(depth, nearest[cells])
    return index[front], rows[front], columns[front], depth[front]


def in_image(
    points: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (m,), pixel rows (m,) and columns (m,) and depths (m,) along the axis, in metres, of the points (n, 3)
    that lie in an image of `shape` (h, w), farther before it than NEAREST; whether anything hides them is not asked."""
    height, width = shape
    to_image = intrinsics @ world_to_camera[:3]
    rotation, translation = to_image[:, :3], to_image[:, 3]  # a row at a time: most points are behind the camera
    depth = points @ rotation[2] + translation[2]
    before = np.flatnonzero(depth > NEAREST)
    depth = depth[before]
    x, y = (((points @ rotation[i])[before] + translation[i]) / depth for i in range(2))
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
    return before[inside], y[inside].astype(np.int64), x[inside].astype(np.int64), depth[inside]
