"""The distance of Gaussians from a road in one pass, and its gradients in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import store_quaternion, store_three, three, unit
from drivesplat.kernels.triton.vectors import dot, rotation_gradient, rotation_rows, scaled, times, turned_back

BLOCK, SUMS = 256, 1024
"""Gaussians per program, and sums of such blocks that are read at a time."""
MIN_WEIGHT = tl.constexpr(1e-6)
"""Distances are divided by the sum of their weights, at least by this."""


class TritonRoadDistance(torch.autograd.Function):
    """`drivesplat.kernels.road_distance.road_distance`, of at least one Gaussian and one cell."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, road: Any, roughness: float
    ) -> Tensor:
        given = tuple(values.contiguous() for values in (means, quats, scales))
        planes = road.normals.contiguous(), road.offsets.contiguous(), road.weights.contiguous()
        count, blocks = len(means), triton.cdiv(len(means), BLOCK)
        cells = torch.empty(count, dtype=torch.int32, device=means.device)
        partial, distance, weight = means.new_empty(2, blocks), means.new_empty(()), means.new_empty(())
        grid, (rows, columns) = road.cells, road.cells.shape
        _distances[(blocks,)](
            *given, opacities.contiguous(), *planes, grid.keys, grid.lower, cells, partial, count, len(grid.keys),
            rows, columns, grid.edge, road.reach, roughness, len(grid.keys).bit_length(), BLOCK,
        )  # fmt: skip
        _mean[(1,)](partial, distance, weight, blocks, SUMS)
        ctx.save_for_backward(*given, *planes, cells, weight)
        ctx.roughness = roughness
        return distance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_distance: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        gradients, count = [torch.empty_like(values) for values in saved[:3]], len(saved[0])
        _distances_backward[(triton.cdiv(count, BLOCK),)](*saved, v_distance, *gradients, count, ctx.roughness, BLOCK)
        return *gradients, None, None, None


@triton.jit(do_not_specialize=["count", "known", "rows", "columns", "edge", "reach", "roughness"])
@no_type_check
def _distances(
    means, quats, scales, opacities, normals, offsets, weights, keys, lower, cells, partial, count, known,
    rows, columns, edge, reach, roughness, STEPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the cell of each Gaussian of the road, -1 for others, and a block's sums of weighted distances and of
    weights."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    opaque = tl.load(opacities + i, mask=i < count, other=0.0) > 0.0
    x, y, z = three(means, i, opaque)
    row = tl.floor((x - tl.load(lower)) / edge)
    column = tl.floor((y - tl.load(lower + 1)) / edge)
    inside = opaque & (row >= 0.0) & (row < rows) & (column >= 0.0) & (column < columns)
    key = tl.where(inside, row, 0.0).to(tl.int64) * columns + tl.where(inside, column, 0.0).to(tl.int64)
    first, behind = tl.zeros((BLOCK,), tl.int32), tl.zeros((BLOCK,), tl.int32) + known
    for _ in range(STEPS):  # the first key that is not smaller
        middle = (first + behind) // 2
        searching = first < behind
        smaller = searching & (tl.load(keys + middle, mask=searching, other=0) < key)
        behind = tl.where(searching & ~smaller, middle, behind)
        first = tl.where(smaller, middle + 1, first)
    inside = inside & (first < known)
    inside = inside & (tl.load(keys + first, mask=inside, other=-1) == key)
    normal = three(normals, first, inside)
    height = dot((x, y, z), normal) - tl.load(offsets + first, mask=inside, other=0.0)
    inside = inside & (tl.abs(height) < reach)
    _, _, _, _, along = _along(quats, scales, i, inside, normal)
    distance = tl.sqrt(height * height + dot(along, along) + roughness * roughness) - roughness
    weight = tl.load(weights + first, mask=inside, other=0.0)
    tl.store(cells + i, tl.where(inside, first, -1), mask=i < count)
    tl.store(partial + tl.program_id(0), tl.sum(weight * distance))
    tl.store(partial + tl.num_programs(0) + tl.program_id(0), tl.sum(weight))


@triton.jit(do_not_specialize=["blocks"])
@no_type_check
def _mean(partial, distance, weight, blocks, BLOCK: tl.constexpr):
    """Writes the weighted mean distance, and the sum of weights, by the sums of all blocks."""
    distances, weights = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for begin in range(0, blocks, BLOCK):
        block = begin + tl.arange(0, BLOCK)
        distances += tl.load(partial + block, mask=block < blocks, other=0.0)
        weights += tl.load(partial + blocks + block, mask=block < blocks, other=0.0)
    divisor = tl.maximum(tl.sum(weights), MIN_WEIGHT)
    tl.store(weight, divisor)
    tl.store(distance, tl.sum(distances) / divisor)


@triton.jit(do_not_specialize=["count", "roughness"])
@no_type_check
def _distances_backward(
    means, quats, scales, normals, offsets, weights, cells, weight_sum, v_distance, v_means, v_quats, v_scales,
    count, roughness, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes all gradients."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    written = i < count
    cell = tl.load(cells + i, mask=written, other=-1)
    inside = cell >= 0
    normal = three(normals, cell, inside)
    height = dot(three(means, i, inside), normal) - tl.load(offsets + cell, mask=inside, other=0.0)
    quat, length, scale, in_own, along = _along(quats, scales, i, inside, normal)
    w, x, y, z = quat
    weight = tl.load(weights + cell, mask=inside, other=0.0) * tl.load(v_distance) / tl.load(weight_sum)
    by_square = weight / tl.sqrt(height * height + dot(along, along) + roughness * roughness)
    by_mean, by_along = scaled(by_square * height, normal), scaled(by_square, along)
    by_scale, by_own = times(by_along, in_own), times(by_along, scale)
    # in_own is the transposed rotation times the normal
    by_rows = scaled(normal[0], by_own), scaled(normal[1], by_own), scaled(normal[2], by_own)
    by_w, by_x, by_y, by_z = rotation_gradient(w, x, y, z, by_rows)
    radial = by_w * w + by_x * x + by_y * y + by_z * z
    by_w, by_x = (by_w - radial * w) / length, (by_x - radial * x) / length
    by_y, by_z = (by_y - radial * y) / length, (by_z - radial * z) / length
    store_three(v_means, i, by_mean[0], by_mean[1], by_mean[2], written)
    store_three(v_scales, i, by_scale[0], by_scale[1], by_scale[2], written)
    store_quaternion(v_quats, i, by_w, by_x, by_y, by_z, written)


@triton.jit
@no_type_check
def _along(quats, scales, i, mask, normal):
    """The unit quaternions of the Gaussians i of a mask, their lengths before normalisation, their scales, the normal
    in their own axes, and its product with the scales."""
    w, x, y, z, length = unit(quats, i, mask)
    scale = three(scales, i, mask)
    in_own = turned_back(rotation_rows(w, x, y, z), normal)
    return (w, x, y, z), length, scale, in_own, times(scale, in_own)
