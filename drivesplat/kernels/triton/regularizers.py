"""The mean opacity and scale of Gaussians, or their mean thickness, in one pass, and the gradients in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.rows import store_three, three

BLOCK = 1024
"""Gaussians per program."""
NAN = tl.constexpr(tl.PropagateNan.ALL)
"""Makes a minimum with NaN NaN, as torch's is."""


class MeanOpacityAndScale(torch.autograd.Function):
    """`drivesplat.kernels.regularizers.mean_opacity_and_scale`, of at least one Gaussian; `sets` holds the opacities
    and the scales of each set."""

    @staticmethod
    def forward(ctx: Any, *sets: Tensor) -> tuple[Tensor, Tensor]:
        given = tuple(values.contiguous() for values in sets)
        counts = [len(opacities) for opacities in given[::2]]
        programs, new = [triton.cdiv(count, BLOCK) for count in counts], given[0].new_empty
        blocks, partial, opacity, scale = sum(programs), new(2, sum(programs)), new(()), new(())
        first = 0
        for opacities, scales, count, own in zip(given[::2], given[1::2], counts, programs, strict=True):
            if own:
                _sums[(own,)](opacities, scales, partial, count, first, blocks, BLOCK)
            first += own
        _means[(1,)](partial, opacity, scale, blocks, sum(counts), BLOCK)
        ctx.save_for_backward(*given[::2])
        return opacity, scale

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_opacity: Tensor, v_scale: Tensor) -> tuple[Tensor, ...]:
        found: list[Tensor] = []
        total = sum(len(opacities) for opacities in ctx.saved_tensors)
        for opacities in ctx.saved_tensors:
            count = len(opacities)
            v_opacities, v_scales = torch.empty_like(opacities), opacities.new_empty(count, 3)
            if count:
                grid = (triton.cdiv(count, BLOCK),)
                _spread[grid](opacities, v_opacity, v_scale, v_opacities, v_scales, count, total, BLOCK)
            found += v_opacities, v_scales
        return tuple(found)


class MeanThickness(torch.autograd.Function):
    """`drivesplat.kernels.regularizers.mean_thickness`, of at least one Gaussian."""

    @staticmethod
    def forward(ctx: Any, scales: Tensor) -> Tensor:
        scales, count = scales.contiguous(), len(scales)
        blocks = triton.cdiv(count, BLOCK)
        partial = scales.new_empty(blocks)
        _thinnest[(blocks,)](scales, partial, count, BLOCK)
        ctx.save_for_backward(scales)
        return partial.sum() / count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_thickness: Tensor) -> Tensor:
        (scales,) = ctx.saved_tensors
        v_scales = torch.empty_like(scales)
        _spread_to_thinnest[(triton.cdiv(len(scales), BLOCK),)](scales, v_thickness, v_scales, len(scales), BLOCK)
        return v_scales


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _thinnest(scales, partial, count, BLOCK: tl.constexpr):
    """A block's sum of smallest scales."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, z = three(scales, i, i < count)
    thinnest = tl.minimum(tl.minimum(x, y, NAN), z, NAN)
    tl.store(partial + tl.program_id(0), tl.sum(thinnest))


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _spread_to_thinnest(scales, v_thickness, v_scales, count, BLOCK: tl.constexpr):
    """Writes the gradients of scales: that of the smallest one, the first of equal ones, is not 0."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, share = i < count, tl.load(v_thickness) / count
    x, y, z = three(scales, i, inside)
    by_x, by_y = (x <= y) & (x <= z), (y < x) & (y <= z)
    by_z = ~by_x & ~by_y
    store_three(v_scales, i, tl.where(by_x, share, 0.0), tl.where(by_y, share, 0.0), tl.where(by_z, share, 0.0), inside)


@triton.jit(do_not_specialize=["count", "first", "blocks"])
@no_type_check
def _sums(opacities, scales, partial, count, first, blocks, BLOCK: tl.constexpr):
    """A block's sums of opacities, and of the scales of Gaussians with an opacity; a set writes those of its blocks
    from `first` on, of so many `blocks` of all sets."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    opacity = tl.load(opacities + i, mask=i < count, other=0.0)
    present = opacity > 0.0
    length = tl.load(scales + 3 * i, mask=present, other=0.0)
    length += tl.load(scales + 3 * i + 1, mask=present, other=0.0)
    length += tl.load(scales + 3 * i + 2, mask=present, other=0.0)
    tl.store(partial + first + tl.program_id(0), tl.sum(opacity))
    tl.store(partial + blocks + first + tl.program_id(0), tl.sum(length))


@triton.jit(do_not_specialize=["blocks", "count"])
@no_type_check
def _means(partial, opacity, scale, blocks, count, BLOCK: tl.constexpr):
    """Writes the means by the sums of all blocks."""
    of_opacities, of_scales = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for begin in range(0, blocks, BLOCK):
        block = begin + tl.arange(0, BLOCK)
        of_opacities += tl.load(partial + block, mask=block < blocks, other=0.0)
        of_scales += tl.load(partial + blocks + block, mask=block < blocks, other=0.0)
    tl.store(opacity, tl.sum(of_opacities) / count)
    tl.store(scale, tl.sum(of_scales) / (3.0 * count))


@triton.jit(do_not_specialize=["count", "total"])
@no_type_check
def _spread(opacities, v_opacity, v_scale, v_opacities, v_scales, count, total, BLOCK: tl.constexpr):
    """Writes the gradients of opacities and scales of a set of `count` Gaussians, of `total` in all sets."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    present = tl.load(opacities + i, mask=inside, other=0.0) > 0.0
    by_opacity = tl.load(v_opacity) / total
    by_scale = tl.where(present, tl.load(v_scale) / (3.0 * total), 0.0)
    tl.store(v_opacities + i, tl.full((BLOCK,), 1.0, tl.float32) * by_opacity, mask=inside)
    for axis in tl.static_range(3):
        tl.store(v_scales + 3 * i + axis, by_scale, mask=inside)
