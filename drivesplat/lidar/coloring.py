"""Point colours from the images that see the points."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from threading import Lock

import numpy as np

from drivesplat.io.prefetch import prefetch
from drivesplat.scene.rigid import inverse
from drivesplat.scene.shutter import Shutter, where_seen


@dataclass(frozen=True)
class ColorView:
    """An image that colours points. `pixels` (h, w, 3) uint8, `usable` (h, w) bool, continuous `intrinsics`; `shutter`
    is None for a global one."""

    pixels: np.ndarray
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    timestamp: int
    usable: np.ndarray
    shutter: Shutter | None = None

    def where_seen(self, points: np.ndarray) -> np.ndarray:
        """Resting world points (n, 3) moved as `drivesplat.scene.shutter.where_seen` does."""
        height, width = self.pixels.shape[:2]
        return where_seen(points, self.shutter, inverse(self.world_to_camera), self.intrinsics, (width, height))


KEPT_BYTES = 2**30
"""Bytes of images that `KeptViews` keeps in memory."""


class KeptViews:
    """Views that are read by their index. The first of them, up to KEPT_BYTES, stay in memory and are read once.
    Threads may share them."""

    def __init__(self, read: Callable[[int], ColorView]):
        self._read = read
        self._kept: dict[int, ColorView] = {}
        self._free = KEPT_BYTES
        self._lock = Lock()

    def __getitem__(self, index: int) -> ColorView:
        kept = self._kept.get(index)
        if kept is not None:
            return kept
        view = self._read(index)
        size = view.pixels.nbytes + view.usable.nbytes
        with self._lock:
            if size <= self._free:
                self._free -= size
                self._kept[index] = view
        return view


CELL = 4
"""Edge in pixels of the cells of the depth buffer that decides occlusion: LiDAR is sparser than the image."""
MIN_DEPTH = 0.5
"""Depth in metres up to which points are ignored."""
OCCLUSION_FACTOR = 1.05
"""A point is occluded if another point in its cell is nearer by this factor and half a metre."""


def hidden_behind(depth: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """Whether points at `depth` (m,) are occluded by points at `nearest` (m,), both in metres: (m,) bool."""
    return depth > nearest * OCCLUSION_FACTOR + 0.5


def color_by_visibility(
    points: np.ndarray, times: np.ndarray, views: Iterable[ColorView]
) -> tuple[np.ndarray, np.ndarray]:
    """Colours every point from the view nearest in time among those that see it unoccluded.

    `points` (n, 3) world; `times` (n,) microseconds. Returns colours (n, 3) uint8, undefined for unseen points,
    and the number (n,) of views that see each point.
    """

    def seen_by(view: ColorView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The points that a view sees, their colours in it, and how far from its own time (microseconds) theirs are."""
        shown, shape = view.where_seen(points), view.pixels.shape[:2]
        index, rows, columns, _ = visible(shown, view.world_to_camera, view.intrinsics, shape)
        usable = view.usable[rows, columns]
        index = index[usable]
        return index, view.pixels[rows[usable], columns[usable]], np.abs(times[index] - view.timestamp)

    colors = np.zeros((len(points), 3), dtype=np.uint8)
    best = np.full(len(points), np.inf)
    seen = np.zeros(len(points), dtype=np.int64)
    for index, in_view, apart in prefetch(seen_by, views):
        seen[index] += 1
        better = np.flatnonzero(apart < best[index])
        improved = index[better]
        best[improved], colors[improved] = apart[better], in_view[better]
    return colors, seen


def visible(
    points: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Indices (m,), pixel rows (m,) and columns (m,), and depths (m,) along the axis in metres, of the points (n, 3)
    that are visible in an image of `shape` (h, w).

    Points occlude each other within cells of CELL x CELL pixels (`hidden_behind`).
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
    that project into an image of `shape` (h, w) from beyond MIN_DEPTH; occlusion is ignored."""
    height, width = shape
    to_image = intrinsics @ world_to_camera[:3]
    rotation, translation = to_image[:, :3], to_image[:, 3]  # row by row: most points are behind the camera
    depth = points @ rotation[2] + translation[2]
    before = np.flatnonzero(depth > MIN_DEPTH)
    depth = depth[before]
    x, y = (((points @ rotation[i])[before] + translation[i]) / depth for i in range(2))
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
    return before[inside], y[inside].astype(np.int64), x[inside].astype(np.int64), depth[inside]
