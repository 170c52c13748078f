"""The mean opacity and scale of Gaussians in one pass, and their gradients in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 1024
"""Gaussians per program."""


class MeanOpacityAndScale(torch.autograd.Function):
    """`drivesplat.kernels.regularizers.mean_opacity_and_scale`, of at least one Gaussian."""

    @staticmethod
    def forward(ctx: Any, opacities: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
        opacities, scales, count = opacities.contiguous(), scales.contiguous(), len(opacities)
        blocks = triton.cdiv(count, BLOCK)
        partial = opacities.new_empty(2, blocks)
        _sums[(blocks,)](opacities, scales, partial, count, BLOCK)
        ctx.save_for_backward(opacities)
        means = partial.sum(dim=1) / count
        return means[0], means[1] / 3.0

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_opacity: Tensor, v_scale: Tensor) -> tuple[Tensor, Tensor]:
        (opacities,) = ctx.saved_tensors
        count = len(opacities)
        v_opacities, v_scales = torch.empty_like(opacities), opacities.new_empty(count, 3)
        _spread[(triton.cdiv(count, BLOCK),)](opacities, v_opacity, v_scale, v_opacities, v_scales, count, BLOCK)
        return v_opacities, v_scales


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _sums(opacities, scales, partial, count, BLOCK: tl.constexpr):
    """A block's sums of opacities, and of the scales of Gaussians with an opacity."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    opacity = tl.load(opacities + i, mask=i < count, other=0.0)
    present = opacity > 0.0
    length = tl.load(scales + 3 * i, mask=present, other=0.0)
    length += tl.load(scales + 3 * i + 1, mask=present, other=0.0)
    length += tl.load(scales + 3 * i + 2, mask=present, other=0.0)
    tl.store(partial + tl.program_id(0), tl.sum(opacity))
    tl.store(partial + tl.num_programs(0) + tl.program_id(0), tl.sum(length))


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _spread(opacities, v_opacity, v_scale, v_opacities, v_scales, count, BLOCK: tl.constexpr):
    """Writes the gradients of opacities and scales."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    present = tl.load(opacities + i, mask=inside, other=0.0) > 0.0
    by_opacity = tl.load(v_opacity) / count
    by_scale = tl.where(present, tl.load(v_scale) / (3.0 * count), 0.0)
    tl.store(v_opacities + i, tl.full((BLOCK,), 1.0, tl.float32) * by_opacity, mask=inside)
    for axis in tl.static_range(3):
        tl.store(v_scales + 3 * i + axis, by_scale, mask=inside)
