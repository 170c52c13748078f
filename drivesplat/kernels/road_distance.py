"""The distance of Gaussians from the surface of a road."""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.quaternions import rotated_back
from drivesplat.kernels.sparse_grid import SparseGrid

ROUGHNESS = 0.05
"""Tolerated error of road and poses in metres: the transition of the loss from quadratic to linear."""
DEEPEST = 5.0
"""Metres below the road beyond which there may be another road, as below a bridge."""


@dataclass(frozen=True)
class Road:
    """The road by horizontal `cells`, each with a plane: its unit normal (`normals`, (k, 3)), its offset along the
    normal in metres (`offsets`, (k,)) and its weight in [0, 1] (`weights`, (k,)). Gaussians with centres within `reach`
    metres of the plane belong to the road."""

    cells: SparseGrid
    normals: Float[Tensor, "k 3"]
    offsets: Float[Tensor, " k"]
    weights: Float[Tensor, " k"]
    reach: float

    def to(self, device: torch.device) -> "Road":
        tensors = {name: getattr(self, name).to(device) for name in ("cells", "normals", "offsets", "weights")}
        return replace(self, **tensors)

    @torch.no_grad()
    def is_above(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Whether the road passes `reach` to DEEPEST metres above points in world coordinates (metres); False where
        there is no road. No host synchronisation."""
        if len(self.weights) == 0:
            return torch.zeros(len(points), dtype=torch.bool, device=points.device)
        cell, known = self.cells.lookup(points[:, :2])
        heights = self.heights(points, cell)
        return known & (heights < -self.reach) & (heights > -DEEPEST)

    def heights(self, points: Float[Tensor, "n 3"], cell: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The signed distances in metres of points from the planes of given cells, positive above them."""
        return (points * self.normals[cell]).sum(dim=1) - self.offsets[cell]


def road_distance(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    road: Road,
) -> Float[Tensor, ""]:
    """The weighted mean distance in metres of the road's Gaussians from its surface: sqrt(d² + nᵀ Σ n + c²) - c, the
    pseudo-Huber norm.

    With the plane's normal n, d the signed distance of the centre from it, and Σ the covariance, d² + nᵀ Σ n is the
    mean square distance of a Gaussian's mass from the plane, minimal for a centre in the plane and the shortest axis
    along its normal. c is ROUGHNESS. `means` are in world coordinates (metres), `quats` of any length, `scales`
    standard deviations in metres. Gaussians farther away than `reach` and those of opacity 0 do not count. 0 where no
    Gaussian counts.
    """
    if len(road.weights) == 0 or len(means) == 0:
        return means.sum() * 0.0
    if triton_support.usable_for(means):
        from drivesplat.kernels.triton.road_distance import TritonRoadDistance as OnGpu

        return OnGpu.apply(means, quats, scales, opacities, road, ROUGHNESS)
    if not means.is_cuda:
        from drivesplat.kernels.numba.road_distance import NumbaRoadDistance as OnCpu

        return OnCpu.apply(means, quats, scales, opacities, road, ROUGHNESS)
    return by_torch(means, quats, scales, opacities, road)


def by_torch(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    road: Road,
) -> Float[Tensor, ""]:
    """`road_distance` in operations of torch, of at least one Gaussian and one cell."""
    cell, on_road = road.cells.lookup(means[:, :2])
    heights = road.heights(means, cell)
    on_road &= (heights.detach().abs() < road.reach) & (opacities.detach() > 0.0)
    weights = road.weights[cell] * on_road
    along = rotated_back(F.normalize(quats, dim=1), road.normals[cell]) * scales
    distance = torch.sqrt(heights.square() + along.square().sum(dim=1) + ROUGHNESS**2) - ROUGHNESS
    return (weights * distance).sum() / weights.sum().clamp(min=1e-6)
