"""The distance of Gaussians from a road and its gradients, in one pass."""

import math
from typing import Any, no_type_check

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.rotations import quat_gradient, rotation_entries
from drivesplat.kernels.numba.threads import parallel_for

CHUNK = 2048
"""Gaussians per chunk; sums over Gaussians are made chunk by chunk."""


class NumbaRoadDistance(torch.autograd.Function):
    """`drivesplat.kernels.road_distance.road_distance`, of at least one Gaussian and one cell."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, road: Any, roughness: float
    ) -> Tensor:
        gradients = [torch.zeros_like(v, memory_format=torch.contiguous_format) for v in (means, quats, scales)]
        sums = np.zeros((-(-len(means) // CHUNK), 2))
        cells = road.cells
        lower_x, lower_y = cells.lower.tolist()
        keys, (rows, columns) = cells.keys.numpy(), cells.shape
        grid = np.array([lower_x, lower_y, cells.edge, rows, columns])
        row_starts = np.searchsorted(keys, columns * np.arange(rows + 1))
        parallel_for(
            _distances, len(means), CHUNK, *arrays(means, quats, scales, opacities), keys, row_starts, grid,
            *arrays(road.normals, road.offsets, road.weights), road.reach, roughness, sums, *arrays(*gradients),
        )  # fmt: skip
        total, weight = sums.sum(axis=0).tolist()
        weight = max(weight, 1e-6)
        ctx.save_for_backward(*gradients)
        ctx.weight = weight
        return means.new_tensor(total / weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_distance: Tensor) -> tuple[Tensor | None, ...]:
        factor = v_distance / ctx.weight
        return *(factor * gradient for gradient in ctx.saved_tensors), None, None, None


@kernel
@no_type_check
def _distances(
    start, stop, means, quats, scales, opacities, keys, row_starts, grid, normals, offsets, weights, reach,
    roughness, sums, v_means, v_quats, v_scales,
):  # fmt: skip
    """Writes a chunk's sums of weighted distances and of weights, and adds the gradients of the former."""
    total, weight_sum = 0.0, 0.0
    for g in range(start, stop):
        if not opacities[g] > 0.0:
            continue
        x, y = float(means[g, 0]), float(means[g, 1])
        cell = _cell(x, y, keys, row_starts, grid)
        if cell < 0:
            continue
        n0, n1, n2 = float(normals[cell, 0]), float(normals[cell, 1]), float(normals[cell, 2])
        height = x * n0 + y * n1 + means[g, 2] * n2 - offsets[cell]
        if not abs(height) < reach:
            continue
        w, x, y, z, norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(quats[g])
        s0, s1, s2 = float(scales[g, 0]), float(scales[g, 1]), float(scales[g, 2])
        own0, own1, own2 = (
            r00 * n0 + r10 * n1 + r20 * n2,
            r01 * n0 + r11 * n1 + r21 * n2,
            r02 * n0 + r12 * n1 + r22 * n2,
        )
        along0, along1, along2 = s0 * own0, s1 * own1, s2 * own2
        distance = math.sqrt(
            height * height + along0 * along0 + along1 * along1 + along2 * along2 + roughness * roughness
        )
        weight = float(weights[cell])
        total += weight * (distance - roughness)
        weight_sum += weight
        factor = weight / distance
        v_means[g, 0] += factor * height * n0
        v_means[g, 1] += factor * height * n1
        v_means[g, 2] += factor * height * n2
        along0, along1, along2 = factor * along0, factor * along1, factor * along2
        v_scales[g, 0] += along0 * own0
        v_scales[g, 1] += along1 * own1
        v_scales[g, 2] += along2 * own2
        v0, v1, v2 = along0 * s0, along1 * s1, along2 * s2  # of the normal in the Gaussian's own axes
        rows = (n0 * v0, n0 * v1, n0 * v2), (n1 * v0, n1 * v1, n1 * v2), (n2 * v0, n2 * v1, n2 * v2)
        v_w, v_x, v_y, v_z = quat_gradient(w, x, y, z, norm, rows[0], rows[1], rows[2])
        v_quats[g, 0] += v_w
        v_quats[g, 1] += v_x
        v_quats[g, 2] += v_y
        v_quats[g, 3] += v_z
    sums[start // CHUNK, 0] = total
    sums[start // CHUNK, 1] = weight_sum


@callee
@no_type_check
def _cell(x, y, keys, row_starts, grid):
    """The listed cell of a point, -1 for none. In rows without gaps it is found at once."""
    row, column = math.floor((x - grid[0]) / grid[2]), math.floor((y - grid[1]) / grid[2])
    if not (0 <= row < grid[3] and 0 <= column < grid[4]):
        return -1
    key = int(row) * int(grid[4]) + int(column)
    first, behind = row_starts[int(row)], row_starts[int(row) + 1]
    if first == behind or key < keys[first]:
        return -1
    guess = first + key - keys[first]
    if guess < behind and keys[guess] == key:
        return guess
    while first < behind:
        middle = (first + behind) // 2
        if keys[middle] < key:
            first = middle + 1
        else:
            behind = middle
    return first if first < len(keys) and keys[first] == key else -1
