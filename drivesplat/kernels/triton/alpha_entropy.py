"""The entropy of an alpha image, or its cross entropy with a mask, in one pass, and the gradient in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 1024
"""Pixels per program."""


class MeanEntropy(torch.autograd.Function):
    """`drivesplat.kernels.alpha_entropy.mean_entropy`, or with a mask of empty pixels `mean_cross_entropy`, of at least
    one pixel."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, empty: Tensor | None, certain: float) -> Tensor:
        given = alpha.contiguous(), None if empty is None else empty.contiguous()
        count = alpha.numel()
        partial = alpha.new_empty(triton.cdiv(count, BLOCK))
        _sums[(len(partial),)](*given, partial, certain, count, empty is not None, BLOCK)
        ctx.save_for_backward(*given)
        ctx.certain = certain
        return partial.sum() / count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor, None, None]:
        alpha, empty = ctx.saved_tensors
        v_alpha, count = torch.empty_like(alpha), alpha.numel()
        blocks = triton.cdiv(count, BLOCK)
        _gradients[(blocks,)](alpha, empty, v_mean, v_alpha, ctx.certain, count, empty is not None, BLOCK)
        return v_alpha, None, None


@triton.jit(do_not_specialize=["certain", "count"])
@no_type_check
def _sums(alpha, empty, partial, certain, count, MASKED: tl.constexpr, BLOCK: tl.constexpr):
    """A block's sum of entropies or cross entropies."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    o = _limited(tl.load(alpha + i, mask=inside, other=0.0), certain)
    opaque, clear = -tl.log(o), -tl.log(1.0 - o)
    if MASKED:
        found = tl.where(tl.load(empty + i, mask=inside, other=0) != 0, clear, opaque)
    else:
        found = o * opaque + (1.0 - o) * clear
    tl.store(partial + tl.program_id(0), tl.sum(tl.where(inside, found, 0.0)))


@triton.jit(do_not_specialize=["certain", "count"])
@no_type_check
def _gradients(alpha, empty, v_mean, v_alpha, certain, count, MASKED: tl.constexpr, BLOCK: tl.constexpr):
    """Writes the gradients of alpha."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside, share = i < count, tl.load(v_mean) / count
    given = tl.load(alpha + i, mask=inside, other=0.0)
    o = _limited(given, certain)
    if MASKED:
        slope = tl.where(tl.load(empty + i, mask=inside, other=0) != 0, 1.0 / (1.0 - o), -1.0 / o)
    else:
        slope = tl.log((1.0 - o) / o)
    tl.store(v_alpha + i, tl.where((given < certain) | (given > 1.0 - certain), 0.0, share * slope), mask=inside)


@triton.jit
@no_type_check
def _limited(alpha, certain):
    """Alpha within the limits; NaN stays NaN."""
    return tl.where(alpha < certain, certain, tl.where(alpha > 1.0 - certain, 1.0 - certain, alpha))
