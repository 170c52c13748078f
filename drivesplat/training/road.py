"""The road under the car's path: a surface that is known, since the car stood on it.

The ego frame lies on the ground under the rear axle. Between two poses its origin goes straight, its vertical turns
evenly; the road at a place is the plane through the nearest point of that path, square to the vertical there.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.road import RoadSettings
from drivesplat.training.floaters import LARGEST_STEP
from drivesplat.training.sparse_grid import SparseGrid

CELL = 0.1
"""Edge in metres, seen from above, of the cells in which the road is a plane."""
ROUGHNESS = 0.05
"""Metres that a road, and the poses of a car on it, may be off without much ado: the loss bends there."""


@dataclass(frozen=True)
class Road:
    """The road by `cells` seen from above: in each a plane, its unit `normals` (k, 3) and how far along it lies,
    `offsets` (k,) metres; and how much it counts, `weights` (k,) in [0, 1]. Centres within `reach` metres are its own.
    """

    cells: SparseGrid
    normals: Float[Tensor, "k 3"]
    offsets: Float[Tensor, " k"]
    weights: Float[Tensor, " k"]
    reach: float

    def to(self, device: torch.device) -> "Road":
        tensors = {name: getattr(self, name).to(device) for name in ("cells", "normals", "offsets", "weights")}
        return replace(self, **tensors)


def road_loss(gaussians: Gaussians, road: Road) -> Float[Tensor, ""]:
    """How far, in metres, the mass of the road's Gaussians lies from it: the weighted mean over them of the
    pseudo-Huber norm sqrt(d² + nᵀ Σ n + c²) - c.

    With the plane's normal n, d the height of the centre over it, and Σ the covariance, d² + nᵀ Σ n is the mean square
    distance of a Gaussian's mass from the plane: least where the centre lies in it and the shortest axis along its
    normal. c is ROUGHNESS: quadratic below, linear above. Gaussians farther out than `reach` are not the road's, nor is
    what is not there, of opacity 0. 0 where there are none.
    """
    if len(road.weights) == 0:
        return gaussians.means.sum() * 0.0
    place, on_it = road.cells.lookup(gaussians.means[:, :2])
    normals = road.normals[place]
    heights = (gaussians.means * normals).sum(dim=1) - road.offsets[place]
    on_it &= (heights.detach().abs() < road.reach) & (gaussians.opacities.detach() > 0.0)
    weights = road.weights[place] * on_it
    axes = rotation_matrix(F.normalize(gaussians.quats, dim=1))
    along = torch.einsum("nij,ni->nj", axes, normals) * gaussians.scales
    distance = torch.sqrt(heights.square() + along.square().sum(dim=1) + ROUGHNESS**2) - ROUGHNESS
    return (weights * distance).sum() / weights.sum().clamp(min=1e-6)


def road_of(record: TrainingRecord, settings: RoadSettings) -> Road:
    """The road under the training images' poses of a training record, on the CPU."""
    images = record.splits["train"]
    in_time = images[np.argsort(record.timestamps[images], kind="stable")]
    return driven_road(record.ego_to_world[in_time], settings)


def driven_road(ego_to_world: np.ndarray, settings: RoadSettings) -> Road:
    """The road under a path of ego poses (m, 4, 4) in time order, on the CPU. Poses farther apart than LARGEST_STEP are
    not joined."""
    origins, verticals = ego_to_world[:, :3, 3], ego_to_world[:, :3, 2]
    joined = np.linalg.norm(np.diff(origins, axis=0), axis=1) < LARGEST_STEP
    first = np.concatenate([np.flatnonzero(joined), np.arange(len(origins))])
    last = np.concatenate([np.flatnonzero(joined) + 1, np.arange(len(origins))])
    lower = np.floor((origins[:, :2].min(axis=0) - settings.half_width) / CELL) * CELL
    shape = np.ceil((origins[:, :2].max(axis=0) + settings.half_width - lower) / CELL).astype(np.int64)
    found = [
        _beside(origins[[a, b]], verticals[[a, b]], lower, shape, settings.half_width)
        for a, b in zip(first, last, strict=True)
    ]
    keys, aside, normals, offsets = (np.concatenate(column) for column in zip(*found, strict=True))
    nearest = np.lexsort([aside, keys])
    keys, nearest = (values[np.unique(keys[nearest], return_index=True)[1]] for values in (keys[nearest], nearest))
    weights = 1.0 - (aside[nearest] / settings.half_width) ** 2
    planes = (torch.from_numpy(values[nearest]).float() for values in (normals, offsets))
    return Road(
        SparseGrid.from_numpy(lower, CELL, shape, keys), *planes, torch.from_numpy(weights).float(), settings.reach
    )


def _beside(
    origins: np.ndarray, verticals: np.ndarray, lower: np.ndarray, shape: np.ndarray, half_width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The cells within `half_width` metres of a segment, seen from above: keys (c,), distances (c,), and of the planes
    there unit normals (c, 3) and offsets (c,). `origins` and `verticals` (2, 3) are those of its ends."""
    corner = np.floor((origins[:, :2].min(axis=0) - half_width - lower) / CELL).clip(0).astype(np.int64)
    end = np.minimum(np.ceil((origins[:, :2].max(axis=0) + half_width - lower) / CELL).astype(np.int64), shape)
    cells = np.stack(np.meshgrid(*map(np.arange, corner, end), indexing="ij"), axis=-1).reshape(-1, 2)
    centres, along = lower + (cells + 0.5) * CELL, origins[1] - origins[0]
    length = max(float(along[:2] @ along[:2]), 1e-12)
    fraction = (((centres - origins[0, :2]) @ along[:2]) / length).clip(0.0, 1.0)[:, None]
    nearest = origins[0] + fraction * along
    aside = np.linalg.norm(centres - nearest[:, :2], axis=1)
    normals = (1.0 - fraction) * verticals[0] + fraction * verticals[1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    near = aside < half_width
    keys = cells[:, 0] * shape[1] + cells[:, 1]
    return keys[near], aside[near], normals[near], (normals * nearest).sum(axis=1)[near]
