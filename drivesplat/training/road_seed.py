"""The seed of the part `road`: a smooth surface through the planes of the ground, and Gaussians spread over it."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import dilated
from drivesplat.model.height_field import HeightField
from drivesplat.model.parameters import random_subset
from drivesplat.model.road import EDGE, RoadSeed, in_layer
from drivesplat.scene.training_record import TrainingRecord

STIFFNESS = 1.0
"""Weight of squared second differences of heights, in units of that of a plane's squared error, for nodes one metre
apart."""
GAP = 3
"""Cells on each side of a gap in the known ground, as behind a vehicle that LiDAR does not see through, up to which the
surface continues in it."""
MARGIN = GAP + 1
"""Nodes around those of known cells that the surface has in addition."""
ANCHOR = 1e-6
"""The same weight of a node's squared height above the mean, which decides where nothing is known."""
NEAR, EVEN, UNEVEN = 0.15, 0.03, 2.0
"""Metres from the surface within which LiDAR points belong to it; the standard deviation of their heights in a cell, or
the difference to a cell beside it (metres), and this many times the median deviation, beyond which the cell is no road:
there is a kerb, or grass."""
MIN_POINTS = 4
"""LiDAR points that decide on a cell."""
LARGEST_SHARE = 0.6
"""Share of the Gaussians of all that is static that the road has at most."""
FINEST = 0.05
"""Metres between neighbouring Gaussians, at least."""
MIN_DEPTH, MIN_RISE = 1.0, 0.2
"""Metres before a camera, and below it, that count where less would."""


def road_seed(record: TrainingRecord, road: Road, cap: int) -> RoadSeed | None:
    """The surface through the planes of a `road`, as far as training images see it, and Gaussians in it: of a `cap` for
    all that is static the share of pixels that the road fills, or as many as the seed points that they replace where
    these are more. They have the colours of the nearest seed points. None where nothing of a road is known or seen, or
    all seed points are in its layer."""
    if not len(road.weights) or not record.train_images:
        return None
    surface, known = surface_of(road, record.points[: record.seed.lidar])
    cells = np.argwhere(surface.covered.numpy())
    lower = surface.lower.double().numpy()
    finest, shown = pixels_of(record, _on(surface, lower + (cells + 0.5) * EDGE))
    seen, every = np.isfinite(finest), record.image_sizes[record.train_images].prod(axis=1).sum()
    covered = torch.zeros_like(surface.covered)
    covered[tuple(cells[seen].T)] = True
    surface = replace(surface, covered=covered)
    replaced = int(in_layer_of(surface, record.points).sum())
    count = int(min(LARGEST_SHARE * cap, max(replaced, cap * shown.sum() * EDGE**2 / every)))
    sown = seen & known[tuple(cells.T)]
    if not count or not sown.any() or replaced == len(record.points):
        return None
    per_side = gaussians_per_side(finest[sown], count)
    places = np.concatenate([_spread(cells[sown][per_side == n], n) for n in np.unique(per_side).tolist()])
    positions = _on(surface, lower + places * EDGE)
    spacing = np.repeat(EDGE / np.sort(per_side), np.sort(per_side) ** 2)
    kept = random_subset(len(positions), count)
    positions, spacing = positions[kept], spacing[kept] * np.sqrt(len(positions) / len(kept))
    _, nearest = cKDTree(record.points).query(positions)
    return RoadSeed(surface, positions, spacing, record.points_rgb[nearest] / 255.0)


def in_layer_of(surface: HeightField, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Whether points (metres) lie in the layer of a road with this surface."""
    return in_layer(surface, _tensor(points).float()).numpy()


def surface_of(road: Road, points: Float[np.ndarray, "p 3"]) -> tuple[HeightField, Bool[np.ndarray, "x y"]]:
    """The smooth surface through the planes of a road with at least one cell, then through the LiDAR `points` (metres)
    near it, and the cells in which it is known. It covers these, and gaps between them, but no cells in which the
    points are uneven; there it may bend.

    Heights z of nodes minimise the sum of (z - known)² over cells, plus STIFFNESS times squared second differences
    along x and along y.
    """
    at = np.stack(np.unravel_index(road.cells.keys.numpy(), road.cells.shape), axis=1)
    middles = road.cells.lower.double().numpy() + (at + 0.5) * road.cells.edge
    normals, offsets = road.normals.double().numpy(), road.offsets.double().numpy()
    known = (offsets - (normals[:, :2] * middles).sum(axis=1)) / normals[:, 2]
    lower = (np.floor(middles.min(axis=0) / EDGE) - MARGIN) * EDGE
    cells = np.floor((middles - lower) / EDGE).astype(np.int64)
    covered = np.zeros(cells.max(axis=0) + 1 + MARGIN, dtype=bool)
    covered[tuple(cells.T)] = True
    heights = _smooth_heights((middles - lower) / EDGE, known, np.zeros_like(covered))
    surface = HeightField(torch.from_numpy(lower).float(), EDGE, torch.from_numpy(heights).float(), _tensor(covered))
    places, over, spread = _returns_by_cell(surface, points)
    uneven = np.zeros_like(covered)
    if len(over):
        own, limit = tuple(np.floor(places).astype(int).T), max(EVEN, UNEVEN * np.median(spread))
        uneven[own] = spread > limit
        means = np.full(covered.shape, np.nan)
        means[own] = over
        uneven |= _beside_a_step(means, limit)
        even = ~uneven[own]
        if even.any():
            heights = heights + _smooth_heights(places[even], over[even], uneven)
            surface = replace(surface, heights=torch.from_numpy(heights).float())
    missed = np.abs(_on(surface, middles)[:, 2] - known) > NEAR
    uneven[tuple(cells[missed].T)] = True
    even = covered & ~uneven
    closed = ndimage.binary_closing(even, iterations=GAP) & ~uneven
    return replace(surface, covered=_tensor(closed)), even


def pixels_of(
    record: TrainingRecord, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The edge (metres) of the smallest pixel that shows points of a level surface in any training image, infinite for
    points that none shows; and how many pixels show a square metre around them, summed over the images.

    The edge is the root of a pixel's area on the surface, for a pinhole camera with a focal length f (pixels) at a
    distance d and a height h above it (d / f) sqrt(d / h). Nothing stands on the surface.
    """
    finest, pixels = np.full(len(points), np.inf), np.zeros(len(points))
    for index in record.train_images:
        pose, K, (width, height) = record.camtoworlds[index], record.Ks[index], record.image_size(index)
        x, y, depth = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        ahead = depth > MIN_DEPTH
        at_x, at_y = (K[i, i] * value / np.where(ahead, depth, 1.0) + K[i, 2] for i, value in enumerate((x, y)))
        shown = ahead & (at_x >= 0.0) & (at_x < width) & (at_y >= 0.0) & (at_y < height)
        distance = np.linalg.norm(points - pose[:3, 3], axis=1)
        rise = np.maximum(pose[2, 3] - points[:, 2], MIN_RISE)
        pixel = distance / np.sqrt(K[0, 0] * K[1, 1]) * np.sqrt(distance / rise)
        finest[shown] = np.minimum(finest, pixel)[shown]
        pixels[shown] += pixel[shown] ** -2.0
    return finest, pixels


def gaussians_per_side(finest: Float[np.ndarray, " n"], count: int) -> Int[np.ndarray, " n"]:
    """How many Gaussians lie along the side of each cell, so that their distances are proportional to its `finest`
    pixel, not below FINEST, and at most `count` lie in all cells, or one in each where that is more.

    >>> gaussians_per_side(np.array([0.01, 0.1, 0.3]), 1000)
    array([10,  5,  2])
    """
    factor, limit = 1.0, max(count, len(finest))
    while True:
        per_side = np.rint(EDGE / np.clip(factor * finest, FINEST, EDGE)).astype(np.int64)
        if np.square(per_side).sum() <= limit:
            return per_side
        factor *= 1.1


def _smooth_heights(
    places: Float[np.ndarray, "k 2"], known: Float[np.ndarray, " k"], bent: Bool[np.ndarray, "x y"]
) -> Float[np.ndarray, "x_and_1 y_and_1"]:
    """The heights of the nodes of a grid by `known` heights at places in units of its cells; their mean beyond MARGIN
    nodes of these. At the nodes of `bent` cells the surface need not be smooth."""
    cells, shape = np.floor(places).astype(np.int64), np.array(bent.shape) + 1
    near = dilated(np.concatenate([cells, cells + 1]), shape, MARGIN)
    number = np.full(shape, -1)
    number[tuple(near.T)] = np.arange(len(near))
    x, y = (places - cells).T
    corners = {(0, 0): (1 - x) * (1 - y), (0, 1): (1 - x) * y, (1, 0): x * (1 - y), (1, 1): x * y}
    columns = np.concatenate([number[tuple((cells + corner).T)] for corner in corners])
    rows = np.tile(np.arange(len(known)), len(corners))
    data = sparse.csr_matrix((np.concatenate(list(corners.values())), (rows, columns)), (len(known), len(near)))
    smooth = np.ones(shape, dtype=bool)
    for corner in corners:
        smooth[tuple((np.argwhere(bent) + corner).T)] = False
    differences = sparse.vstack([_second_differences(number, smooth, axis, len(near)) for axis in (0, 1)])
    stiff, mean = STIFFNESS / EDGE**4 * (differences.T @ differences), known.mean()
    system = data.T @ data + stiff + ANCHOR * sparse.identity(len(near))
    heights = np.full(shape, mean)
    heights[tuple(near.T)] += spsolve(system.tocsc(), data.T @ (known - mean))
    return heights


def _second_differences(
    number: Int[np.ndarray, "x y"], smooth: Bool[np.ndarray, "x y"], axis: int, count: int
) -> sparse.csr_matrix:
    """The second differences of heights along an axis at `smooth` nodes whose two neighbours have a `number`; the
    others have -1."""
    length = number.shape[axis] - 2
    before, at, after = (np.take(number, np.arange(length) + step, axis=axis).ravel() for step in range(3))
    counted = (before >= 0) & (at >= 0) & (after >= 0) & np.take(smooth, np.arange(length) + 1, axis=axis).ravel()
    columns = np.concatenate([before[counted], at[counted], after[counted]])
    rows, weights = np.tile(np.arange(counted.sum()), 3), np.repeat([1.0, -2.0, 1.0], counted.sum())
    return sparse.csr_matrix((weights, (rows, columns)), (counted.sum(), count))


def _beside_a_step(means: Float[np.ndarray, "x y"], limit: float) -> Bool[np.ndarray, "x y"]:
    """The cells whose mean height above a surface, NaN where it is unknown, differs by more than a limit from that of a
    neighbour."""
    found = np.zeros(means.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(means, axis=axis)) > limit  # False beside NaN
        nothing = np.zeros_like(step.take([0], axis=axis))
        found |= np.concatenate([step, nothing], axis=axis) | np.concatenate([nothing, step], axis=axis)
    return found


def _returns_by_cell(
    surface: HeightField, points: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """The LiDAR points near a surface in each cell with MIN_POINTS of them: their mean place in units of cells, and the
    mean and the standard deviation of their heights above the surface (metres)."""
    near = points[surface.layer(_tensor(points).float(), NEAR, NEAR).numpy()].astype(np.float64)
    over = near[:, 2] - _on(surface, near[:, :2])[:, 2]
    places = (near[:, :2] - surface.lower.double().numpy()) / EDGE
    keys = np.ravel_multi_index(np.floor(places).astype(int).T, tuple(surface.covered.shape))
    _, cell, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, weights=values, minlength=len(counts)) for values in (*places.T, over, over**2)]
    x, y, mean, square = (values / counts for values in sums) if len(counts) else np.zeros((4, 0))
    known = counts >= MIN_POINTS
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    return np.column_stack([x, y])[known], mean[known], spread[known]


def _spread(cells: Int[np.ndarray, "k 2"], per_side: int) -> Float[np.ndarray, "m 2"]:
    """Places in cells, in units of these, `per_side` along each side."""
    inside = (np.arange(per_side) + 0.5) / per_side
    grid = np.stack(np.meshgrid(inside, inside, indexing="ij"), axis=-1).reshape(-1, 2)
    return (cells[:, None] + grid).reshape(-1, 2)


def _on(surface: HeightField, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Places with their heights on a surface."""
    return np.column_stack([places, surface.at(_tensor(places).float()).double().numpy()])


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))
