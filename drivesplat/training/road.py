"""The road: a known surface under the ego vehicle's path, where the vehicle stood on it, or wherever a LiDAR saw it.

The ego frame lies on the ground under the rear axle. Between two poses its origin and its vertical axis are
interpolated linearly. The road at a place is the plane through the nearest point of that path, perpendicular to the
vertical there. By LiDAR it is the nearest plane of `drivesplat.lidar.ground.GroundMap`. Both together are the latter
where it is known, and the former elsewhere.
"""

import logging

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import SparseGrid, dilated
from drivesplat.lidar.ground import GroundMap
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import RoadSettings
from drivesplat.training.floaters import LARGEST_STEP

log = logging.getLogger(__name__)

CELL, LIDAR_CELL = 0.1, 0.25
"""Edges in metres of the horizontal cells in each of which the road is a plane, under the path and by LiDAR."""
NEAR_PLANE = 1.0
"""Metres from the place of a plane by LiDAR within which the ground lies in it."""


def road_of(record: TrainingRecord, settings: RoadSettings) -> Road:
    """The road under the training images' poses of a training record, that of its LiDAR seed points, or both, on the
    CPU. Logs where the settings give it no cell."""
    images = record.splits["train"]
    poses = record.ego_to_world[images[np.argsort(record.timestamps[images], kind="stable")]]
    if settings.surface == "path":
        return driven_road(poses, settings)
    ground = lidar_road(record.points[: record.seed.lidar], settings)
    if settings.surface == "lidar_or_path":
        return combined(ground, driven_road(poses, settings, LIDAR_CELL))
    if not len(ground.weights):
        log.info("no LiDAR point shows the ground: train.road_weight has no effect with train.road.surface: lidar")
    return ground


def driven_road(ego_to_world: Float[np.ndarray, "m 4 4"], settings: RoadSettings, cell: float = CELL) -> Road:
    """The road under a path of ego poses in time order, in cells with edges of `cell` metres, on the CPU. Poses farther
    apart than LARGEST_STEP are not connected."""
    origins, verticals = ego_to_world[:, :3, 3], ego_to_world[:, :3, 2]
    joined = np.linalg.norm(np.diff(origins, axis=0), axis=1) < LARGEST_STEP
    first = np.concatenate([np.flatnonzero(joined), np.arange(len(origins))])
    last = np.concatenate([np.flatnonzero(joined) + 1, np.arange(len(origins))])
    lower = np.floor((origins[:, :2].min(axis=0) - settings.half_width) / cell) * cell
    shape = np.ceil((origins[:, :2].max(axis=0) + settings.half_width - lower) / cell).astype(np.int64)
    found = [
        _cells_near(origins[[a, b]], verticals[[a, b]], lower, shape, settings.half_width, cell)
        for a, b in zip(first, last, strict=True)
    ]
    keys, distances, normals, offsets = (np.concatenate(column) for column in zip(*found, strict=True))
    nearest = np.lexsort([distances, keys])
    keys, nearest = (values[np.unique(keys[nearest], return_index=True)[1]] for values in (keys[nearest], nearest))
    weights = 1.0 - (distances[nearest] / settings.half_width) ** 2
    planes = (torch.from_numpy(values[nearest]).float() for values in (normals, offsets))
    return Road(
        SparseGrid.from_numpy(lower, cell, shape, keys), *planes, torch.from_numpy(weights).float(), settings.reach
    )


def lidar_road(points: Float[np.ndarray, "n 3"], settings: RoadSettings) -> Road:
    """The ground wherever LiDAR points of the static world (metres) show it, on the CPU; without any the road has no
    cell."""
    planes = GroundMap(points).planes()
    if not len(planes.places):
        nothing = SparseGrid.from_numpy(np.zeros(2), LIDAR_CELL, np.ones(2, dtype=np.int64), np.zeros(0, np.int64))
        return Road(nothing, torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), settings.reach)
    lower = np.floor((planes.places.min(axis=0) - NEAR_PLANE) / LIDAR_CELL) * LIDAR_CELL
    shape = np.ceil((planes.places.max(axis=0) + NEAR_PLANE - lower) / LIDAR_CELL).astype(np.int64)
    reach = int(NEAR_PLANE / LIDAR_CELL + 0.5)
    cells = dilated(np.floor((planes.places - lower) / LIDAR_CELL).astype(np.int64), shape, reach)
    centres = lower + (cells + 0.5) * LIDAR_CELL
    distances, nearest = cKDTree(planes.places).query(centres, distance_upper_bound=NEAR_PLANE)
    near = np.isfinite(distances)
    keys, nearest = np.ravel_multi_index(cells[near].T, shape), nearest[near]
    normals, offsets = (torch.from_numpy(values[nearest]).float() for values in (planes.normals, planes.offsets))
    return Road(
        SparseGrid.from_numpy(lower, LIDAR_CELL, shape, keys), normals, offsets, torch.ones(len(keys)), settings.reach
    )


def combined(first: Road, second: Road) -> Road:
    """A road with the cells of both; where both have one, that of `first`. Their cells have the same edges and lie at
    multiples of these."""
    roads = [road for road in (first, second) if len(road.weights)]
    if len(roads) < 2:
        return roads[0] if roads else first
    grids, edge = [road.cells for road in roads], first.cells.edge
    corners = [np.rint(grid.lower.numpy() / edge).astype(np.int64) for grid in grids]
    corner = np.minimum(*corners)
    shape = np.maximum(*(own + grid.shape for own, grid in zip(corners, grids, strict=True))) - corner
    keys = []
    for own, grid in zip(corners, grids, strict=True):
        cells = np.stack(np.unravel_index(grid.keys.numpy(), grid.shape), axis=1) + (own - corner)
        keys.append(np.ravel_multi_index(cells.T, shape))
    merged, rows = np.unique(np.concatenate(keys), return_index=True)  # of equal keys the first one
    planes = (torch.cat([getattr(road, name) for road in roads])[rows] for name in ("normals", "offsets", "weights"))
    return Road(SparseGrid.from_numpy(corner * edge, edge, shape, merged), *planes, first.reach)


def _cells_near(
    origins: np.ndarray, verticals: np.ndarray, lower: np.ndarray, shape: np.ndarray, half_width: float, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The cells within `half_width` metres of a segment in the horizontal plane: keys (c,), distances (c,), and of the
    planes there unit normals (c, 3) and offsets (c,). `origins` and `verticals` (2, 3) are those of its ends."""
    corner = np.floor((origins[:, :2].min(axis=0) - half_width - lower) / cell).clip(0).astype(np.int64)
    end = np.minimum(np.ceil((origins[:, :2].max(axis=0) + half_width - lower) / cell).astype(np.int64), shape)
    cells = np.stack(np.meshgrid(*map(np.arange, corner, end), indexing="ij"), axis=-1).reshape(-1, 2)
    centres, along = lower + (cells + 0.5) * cell, origins[1] - origins[0]
    length = max(float(along[:2] @ along[:2]), 1e-12)
    fraction = (((centres - origins[0, :2]) @ along[:2]) / length).clip(0.0, 1.0)[:, None]
    nearest = origins[0] + fraction * along
    distances = np.linalg.norm(centres - nearest[:, :2], axis=1)
    normals = (1.0 - fraction) * verticals[0] + fraction * verticals[1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    near = distances < half_width
    keys = cells[:, 0] * shape[1] + cells[:, 1]
    return keys[near], distances[near], normals[near], (normals * nearest).sum(axis=1)[near]
