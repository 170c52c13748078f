"""The distance of Gaussians from a road in one pass, and its gradients in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.vectors import dot, rotation_gradient, rotation_rows, scaled, turned_back

BLOCK = 256
"""Gaussians per program."""


class RoadDistance(torch.autograd.Function):
    """`drivesplat.kernels.road_distance.road_distance`, of at least one Gaussian and one cell."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, road: Any, roughness: float
    ) -> Tensor:
        given = tuple(values.contiguous() for values in (means, quats, scales))
        planes = road.normals.contiguous(), road.offsets.contiguous(), road.weights.contiguous()
        count, blocks = len(means), triton.cdiv(len(means), BLOCK)
        cells = torch.empty(count, dtype=torch.int32, device=means.device)
        partial = means.new_empty(2, blocks)
        grid, (rows, columns) = road.cells, road.cells.shape
        _distances[(blocks,)](
            *given, opacities.contiguous(), *planes, grid.keys, grid.lower, cells, partial, count, len(grid.keys),
            rows, columns, grid.edge, road.reach, roughness, len(grid.keys).bit_length(), BLOCK,
        )  # fmt: skip
        total, weight = partial.sum(dim=1)
        weight = weight.clamp(min=1e-6)
        ctx.save_for_backward(*given, *planes, cells, weight)
        ctx.roughness = roughness
        return total / weight

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_distance: Tensor) -> tuple[Tensor | None, ...]:
        means, quats, scales, *others = ctx.saved_tensors
        gradients = tuple(torch.empty_like(values) for values in (means, quats, scales))
        arguments = means, quats, scales, *others, v_distance, *gradients, len(means), ctx.roughness, BLOCK
        _distances_backward[(triton.cdiv(len(means), BLOCK),)](*arguments)
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
    x, y, z = _load(means, i, opaque)
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
    normal = _load(normals, first, inside)
    height = dot((x, y, z), normal) - tl.load(offsets + first, mask=inside, other=0.0)
    inside = inside & (tl.abs(height) < reach)
    _, _, _, _, along = _along(quats, scales, i, inside, normal)
    distance = tl.sqrt(height * height + dot(along, along) + roughness * roughness) - roughness
    weight = tl.load(weights + first, mask=inside, other=0.0)
    tl.store(cells + i, tl.where(inside, first, -1), mask=i < count)
    tl.store(partial + tl.program_id(0), tl.sum(weight * distance))
    tl.store(partial + tl.num_programs(0) + tl.program_id(0), tl.sum(weight))


@triton.jit(do_not_specialize=["count", "roughness"])
@no_type_check
def _distances_backward(
    means, quats, scales, normals, offsets, weights, cells, weight_sum, v_distance, v_means, v_quats, v_scales,
    count, roughness, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    cell = tl.load(cells + i, mask=valid, other=-1)
    inside = cell >= 0
    normal = _load(normals, cell, inside)
    height = dot(_load(means, i, inside), normal) - tl.load(offsets + cell, mask=inside, other=0.0)
    quat, length, scale, in_own, along = _along(quats, scales, i, inside, normal)
    w, x, y, z = quat
    weight = tl.load(weights + cell, mask=inside, other=0.0) * tl.load(v_distance) / tl.load(weight_sum)
    by_square = weight / tl.sqrt(height * height + dot(along, along) + roughness * roughness)
    _store(v_means, i, valid, scaled(by_square * height, normal))
    v_along = scaled(by_square, along)
    _store(v_scales, i, valid, (v_along[0] * in_own[0], v_along[1] * in_own[1], v_along[2] * in_own[2]))
    v_own = (v_along[0] * scale[0], v_along[1] * scale[1], v_along[2] * scale[2])
    # in_own is the transposed rotation times the normal
    v_rows = scaled(normal[0], v_own), scaled(normal[1], v_own), scaled(normal[2], v_own)
    v_w, v_x, v_y, v_z = rotation_gradient(w, x, y, z, v_rows)
    radial = v_w * w + v_x * x + v_y * y + v_z * z
    tl.store(v_quats + 4 * i, (v_w - radial * w) / length, mask=valid)
    tl.store(v_quats + 4 * i + 1, (v_x - radial * x) / length, mask=valid)
    tl.store(v_quats + 4 * i + 2, (v_y - radial * y) / length, mask=valid)
    tl.store(v_quats + 4 * i + 3, (v_z - radial * z) / length, mask=valid)


@triton.jit
@no_type_check
def _along(quats, scales, i, mask, normal):
    """The unit quaternions of the Gaussians i of a mask, their lengths before normalisation, their scales, the normal
    in their own axes, and its product with the scales."""
    w, x = tl.load(quats + 4 * i, mask=mask, other=1.0), tl.load(quats + 4 * i + 1, mask=mask, other=0.0)
    y, z = tl.load(quats + 4 * i + 2, mask=mask, other=0.0), tl.load(quats + 4 * i + 3, mask=mask, other=0.0)
    length = tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / length, x / length, y / length, z / length
    scale = _load(scales, i, mask)
    in_own = turned_back(rotation_rows(w, x, y, z), normal)
    along = scale[0] * in_own[0], scale[1] * in_own[1], scale[2] * in_own[2]
    return (w, x, y, z), length, scale, in_own, along


@triton.jit
@no_type_check
def _load(vectors, i, mask):
    """The vectors i of a mask; 0 elsewhere."""
    return (
        tl.load(vectors + 3 * i, mask=mask, other=0.0),
        tl.load(vectors + 3 * i + 1, mask=mask, other=0.0),
        tl.load(vectors + 3 * i + 2, mask=mask, other=0.0),
    )


@triton.jit
@no_type_check
def _store(vectors, i, mask, values):
    """Writes the vectors i of a mask."""
    for axis in tl.static_range(3):
        tl.store(vectors + 3 * i + axis, values[axis], mask=mask)
