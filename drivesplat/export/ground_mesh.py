"""The ground about the path of the ego vehicle as a mesh: smooth, and without holes.

Heights z of the nodes of a horizontal grid minimise the sum of

    w (z - known)²  +  STIFFNESS (squared second differences)  +  LEVEL (squared first differences)

Known are the planes through the poses of the ego vehicle, which stands on the ground, and those of
`drivesplat.lidar.ground.GroundMap`; the latter are reweighted, since some lie on what stands on the ground. Where
nothing is known the surface continues, and becomes level.
"""

import logging

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from drivesplat.io.triangle_mesh import TriangleMesh
from drivesplat.kernels.road_distance import Road
from drivesplat.model.height_field import HeightField
from drivesplat.settings.train import RoadSettings
from drivesplat.training.road import driven_road, lidar_road

log = logging.getLogger(__name__)

EDGE = 1.0
"""Metres between neighbouring nodes."""
REACH = 30.0
"""Metres about the path, and beyond its ends, that the ground covers."""
HALF_WIDTH, CELL = 1.2, 0.25
"""Metres beside the path on which the vehicle stands, and the edge of the cells of known planes."""
STIFFNESS, LEVEL = 1.0, 0.001
"""Weights in units of the weight of a plane by LiDAR, which stands for one node."""
OF_PATH = 10.0
"""The weight of the planes under the vehicle in the same units."""
SAME, ROUNDS = 0.1, 4
"""Metres beyond which the deviation of a plane by LiDAR counts linearly (Huber), and rounds of reweighting."""
OFF = 0.1
"""Metres between the path and the surface beyond which a warning says so."""
MIN_STEP = 0.25
"""Metres between the poses that count."""


def ground_surface(ego_to_world: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "p 3"]) -> HeightField:
    """The ground within REACH of a path of poses in time order, of which it `covers` the cells, by LiDAR `points`
    (metres, none or more) of what does not move.

    A surface of heights has one ground at a place: where the path crosses itself on a bridge, the log warns.
    """
    poses = _apart(ego_to_world)
    places, heights, weights = _known_heights(poses, points)
    lower = np.floor((poses[:, :2, 3].min(axis=0) - REACH) / EDGE) * EDGE - EDGE
    shape = (np.ceil((poses[:, :2, 3].max(axis=0) + REACH - lower) / EDGE) + 2).astype(np.int64)
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 2)
    near = np.isfinite(cKDTree(poses[:, :2, 3]).query(lower + EDGE * nodes, distance_upper_bound=REACH)[0])
    number = np.full(tuple(shape), -1)
    number[tuple(nodes[near].T)] = np.arange(near.sum())
    found = np.full(tuple(shape), poses[:, 2, 3].mean())
    found[tuple(nodes[near].T)] = _fitted(number, (places - lower) / EDGE, heights, weights)
    covered = np.all([corner >= 0 for corner in _corners(number)], axis=0)
    lowest, values, cells = torch.from_numpy(lower).float(), torch.from_numpy(found).float(), torch.from_numpy(covered)
    surface = HeightField(lowest, EDGE, values, cells)
    off = np.abs(surface.at(torch.from_numpy(poses[:, :2, 3]).float()).numpy() - poses[:, 2, 3]).max()
    if off > OFF:
        log.warning("the ground is up to %.1f m off the path of the vehicle, which crosses itself or is uneven", off)
    return surface


def surface_mesh(surface: HeightField) -> TriangleMesh:
    """Two triangles for each covered cell of a surface, with normals that point up."""
    heights, edge = surface.heights.double().numpy(), surface.edge
    nodes = np.stack(np.meshgrid(*map(np.arange, heights.shape), indexing="ij"), axis=-1)
    vertices = np.concatenate([surface.lower.double().numpy() + edge * nodes, heights[..., None]], axis=-1)
    number = np.arange(heights.size).reshape(heights.shape)
    first, in_y, in_x, far = (corner[surface.covered.numpy()] for corner in _corners(number))
    triangles = np.stack([np.stack([first, in_x, far], axis=1), np.stack([first, far, in_y], axis=1)], axis=1)
    return TriangleMesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3)).with_triangles(np.arange(2 * len(first)))


def _apart(ego_to_world: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "m 4 4"]:
    """The first pose, and each that is MIN_STEP from the one before: a standing vehicle counts once."""
    kept = [0]
    for i, place in enumerate(ego_to_world[:, :3, 3]):
        if np.linalg.norm(place - ego_to_world[kept[-1], :3, 3]) >= MIN_STEP:
            kept.append(i)
    return ego_to_world[kept]


def _known_heights(
    poses: Float[np.ndarray, "m 4 4"], points: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """The places (metres) at which the height is known, this height, and its weight; that of planes by LiDAR is
    negative."""
    settings = RoadSettings(half_width=HALF_WIDTH)
    roads = {OF_PATH: driven_road(poses, settings, CELL), -1.0: lidar_road(points, settings)}
    found = [(*_middles(road), np.full(len(road.weights), weight)) for weight, road in roads.items()]
    places, heights, weights = (np.concatenate(column) for column in zip(*found, strict=True))
    near = np.isfinite(cKDTree(poses[:, :2, 3]).query(places, distance_upper_bound=REACH - 2 * EDGE)[0])
    return places[near], heights[near], weights[near] * (CELL / EDGE) ** 2


def _middles(road: Road) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """The middles of the cells of a road, and the heights of their planes there."""
    cells = np.stack(np.unravel_index(road.cells.keys.numpy(), road.cells.shape), axis=1)
    middles = road.cells.lower.double().numpy() + (cells + 0.5) * road.cells.edge
    normals, offsets = road.normals.double().numpy(), road.offsets.double().numpy()
    return middles, (offsets - (normals[:, :2] * middles).sum(axis=1)) / normals[:, 2]


def _fitted(
    number: Int[np.ndarray, "x y"],
    places: Float[np.ndarray, "k 2"],
    known: Float[np.ndarray, " k"],
    weights: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " n"]:
    """The heights of the n nodes with a `number` from 0 on, the others have -1, by `known` heights at places in units
    of the grid; those with a negative weight are reweighted."""
    cells = np.floor(places).astype(np.int64)
    x, y = (places - cells).T
    shares = np.stack([(1 - x) * (1 - y), (1 - x) * y, x * (1 - y), x * y], axis=1)
    nodes = np.stack([number[tuple((cells + corner).T)] for corner in ((0, 0), (0, 1), (1, 0), (1, 1))], axis=1)
    count, rows = int(number.max()) + 1, np.repeat(np.arange(len(known)), 4)
    at_places = sparse.csr_matrix((shares.ravel(), (rows, nodes.ravel())), (len(known), count))
    smooth = STIFFNESS * _squared(number, [1.0, -2.0, 1.0], count) + LEVEL * _squared(number, [-1.0, 1.0], count)
    mean, own = known.mean(), np.abs(weights)
    for _ in range(ROUNDS):
        system = at_places.T @ sparse.diags(own) @ at_places + smooth
        heights = mean + spsolve(system.tocsc(), at_places.T @ (own * (known - mean)))
        deviation = np.abs(at_places @ heights - known)
        own = np.where(weights > 0.0, weights, -weights * np.minimum(1.0, SAME / np.maximum(deviation, 1e-9)))
    return heights


def _squared(number: Int[np.ndarray, "x y"], stencil: list[float], count: int) -> sparse.csr_matrix:
    """The matrix of the sum of squared differences along both axes, with these coefficients, wherever all their nodes
    have a number."""
    total = sparse.csr_matrix((count, count))
    for axis in (0, 1):
        length = number.shape[axis] - len(stencil) + 1
        parts = np.stack([np.take(number, np.arange(length) + i, axis=axis).ravel() for i in range(len(stencil))])
        columns = parts[:, (parts >= 0).all(axis=0)]
        rows = np.tile(np.arange(columns.shape[1]), len(stencil))
        values = np.repeat(stencil, columns.shape[1])
        differences = sparse.csr_matrix((values, (rows, columns.ravel())), (columns.shape[1], count))
        total = total + differences.T @ differences
    return total


def _corners(nodes: Int[np.ndarray, "x y"]) -> tuple[Int[np.ndarray, "x_less_1 y_less_1"], ...]:
    """The values at the four nodes of each cell: the first, the next along y, the next along x, the last."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
