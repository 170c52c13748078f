"""The penalties of corrections of tracks in one kernel, and their gradient in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import add_nonzero, three

BLOCK = 512
"""Annotations, or triples of them, per program of the gradient, and per step of the only one of the sums."""


class SumsOfSquares(torch.autograd.Function):
    """`drivesplat.kernels.regularizers.sums_of_squares`."""

    @staticmethod
    def forward(
        ctx: Any, shifts: Tensor, yaw: Tensor, neighbours: Tensor, per_metre: float, per_radian: float
    ) -> tuple[Tensor, Tensor]:
        shifts, yaw, neighbours = shifts.contiguous(), yaw.contiguous(), neighbours.contiguous()
        size, bend = yaw.new_empty(()), yaw.new_empty(())
        ctx.sizes = len(yaw), len(neighbours), per_metre, per_radian
        _sums[(1,)](shifts, yaw, neighbours, size, bend, *ctx.sizes, BLOCK)
        ctx.save_for_backward(shifts, yaw, neighbours)
        return size, bend

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_size: Tensor, v_bend: Tensor) -> tuple[Tensor | None, ...]:
        shifts, yaw, neighbours = ctx.saved_tensors
        v_shifts, v_yaw = torch.zeros(4 * len(yaw), dtype=yaw.dtype, device=yaw.device).split([3 * len(yaw), len(yaw)])
        blocks = triton.cdiv(max(len(yaw), len(neighbours)), BLOCK)
        if blocks:
            _gradients[(blocks,)](shifts, yaw, neighbours, v_size, v_bend, v_shifts, v_yaw, *ctx.sizes, BLOCK)
        return v_shifts.reshape(-1, 3), v_yaw, None, None, None


@triton.jit
@no_type_check
def _bend(values, first, at, last, stride, inside):
    """Second differences of entries of an array whose rows are `stride` values apart."""
    before = tl.load(values + stride * first, mask=inside, other=0.0)
    here = tl.load(values + stride * at, mask=inside, other=0.0)
    return before - 2.0 * here + tl.load(values + stride * last, mask=inside, other=0.0)


@triton.jit(do_not_specialize=["count", "triples"])
@no_type_check
def _sums(
    shifts, yaw, neighbours, size, bend, count, triples, per_metre, per_radian, BLOCK: tl.constexpr
):  # fmt: skip
    """Writes the sums of squares of all corrections, and of their second differences."""
    of_sizes, of_bends = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    metre, radian = per_metre * per_metre, per_radian * per_radian
    for begin in range(0, count, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        x, y, z = three(shifts, i, i < count)
        turn = tl.load(yaw + i, mask=i < count, other=0.0)
        of_sizes += metre * (x * x + y * y + z * z) + radian * turn * turn
    for begin in range(0, triples, BLOCK):
        i = begin + tl.arange(0, BLOCK)
        inside = i < triples
        first, at, last = three(neighbours, i, inside)
        for axis in tl.static_range(3):
            along = _bend(shifts + axis, first, at, last, 3, inside)
            of_bends += metre * along * along
        turn = _bend(yaw, first, at, last, 1, inside)
        of_bends += radian * turn * turn
    tl.store(size, tl.sum(of_sizes))
    tl.store(bend, tl.sum(of_bends))


@triton.jit
@no_type_check
def _add_bend(total, gradient, first, at, last, stride, inside):
    """Adds the gradient of second differences to those of the entries."""
    add_nonzero(total + stride * first, gradient, inside)
    add_nonzero(total + stride * at, -2.0 * gradient, inside)
    add_nonzero(total + stride * last, gradient, inside)


@triton.jit(do_not_specialize=["count", "triples"])
@no_type_check
def _gradients(
    shifts, yaw, neighbours, v_size, v_bend, v_shifts, v_yaw, count, triples, per_metre, per_radian,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Adds the gradients of corrections."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    by_size, by_bend = 2.0 * tl.load(v_size), 2.0 * tl.load(v_bend)
    metre, radian = per_metre * per_metre, per_radian * per_radian
    known, inside = i < count, i < triples
    first, at, last = three(neighbours, i, inside)
    for axis in tl.static_range(3):
        shift = tl.load(shifts + 3 * i + axis, mask=known, other=0.0)
        add_nonzero(v_shifts + 3 * i + axis, by_size * metre * shift, known)
        along = _bend(shifts + axis, first, at, last, 3, inside)
        _add_bend(v_shifts + axis, by_bend * metre * along, first, at, last, 3, inside)
    add_nonzero(v_yaw + i, by_size * radian * tl.load(yaw + i, mask=known, other=0.0), known)
    turn = _bend(yaw, first, at, last, 1, inside)
    _add_bend(v_yaw, by_bend * radian * turn, first, at, last, 1, inside)
