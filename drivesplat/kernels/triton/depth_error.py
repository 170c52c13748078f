"""The mean of the smallest errors of depth, selected by histograms instead of a sort, and its gradient.

The bits of a positive float32 are an integer of the same order. A histogram of their first 11 bits finds the bin that
the last error that counts is in, and another one of the next 11 bits finds its place there.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK = 1024
"""Errors per program."""
BINS = tl.constexpr(2048)
"""Bins of a histogram: 11 bits."""
FIRST, NEXT = tl.constexpr(20), tl.constexpr(9)
"""The bits behind those of the first histogram, and behind those of the second."""


class MeanDepthError(torch.autograd.Function):
    """`drivesplat.kernels.depth_error.mean_depth_error` of at least one pixel."""

    @staticmethod
    def forward(ctx: Any, depth: Tensor, pixels: Tensor, measured: Tensor, count: Tensor, kept_percent: int) -> Tensor:
        given = depth.contiguous(), pixels.contiguous(), measured.contiguous()
        errors, blocks = torch.empty_like(given[2]), triton.cdiv(len(pixels), BLOCK)
        bins = torch.zeros(2, BINS.value, dtype=torch.int32, device=depth.device)
        partial, last = depth.new_empty(blocks), depth.new_empty(3)
        _errors[(blocks,)](*given, count, errors, bins[0], BLOCK)
        _refine[(blocks,)](errors, count, bins[0], bins[1], kept_percent, BLOCK)
        _sum[(blocks,)](errors, count, bins[0], bins[1], partial, last, kept_percent, BLOCK)
        ctx.save_for_backward(*given, count, last)
        return partial.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor | None, ...]:
        depth, pixels, measured, count, last = ctx.saved_tensors
        v_depth = torch.zeros_like(depth)
        blocks = (triton.cdiv(len(pixels), BLOCK),)
        _gradients[blocks](depth, pixels, measured, count, last, v_mean, v_depth, BLOCK)
        return v_depth, None, None, None, None


@triton.jit
@no_type_check
def _errors(depth, pixels, measured, count, errors, bins, BLOCK: tl.constexpr):
    """Writes the errors, and counts them by their first bits."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = i < tl.load(count)
    at = tl.load(pixels + i, mask=used, other=0)
    error = tl.abs(tl.load(depth + at, mask=used, other=0.0) - tl.load(measured + i, mask=used, other=0.0))
    tl.store(errors + i, error, mask=used)
    tl.atomic_add(bins + (error.to(tl.int32, bitcast=True) >> FIRST), 1, mask=used, sem="relaxed")


@triton.jit
@no_type_check
def _kept(count, kept_percent: tl.constexpr):
    return tl.maximum(tl.load(count) * kept_percent // 100, 1).to(tl.int32)


@triton.jit
@no_type_check
def _found(bins, rank):
    """The bin with the entry of this rank, from 1 on, and the entries before it and in it."""
    each = tl.arange(0, BINS)
    entries = tl.load(bins + each)
    found = tl.sum((tl.cumsum(entries, 0) < rank).to(tl.int32))
    before = tl.sum(tl.where(each < found, entries, 0))
    return found, before, tl.sum(tl.where(each == found, entries, 0))


@triton.jit
@no_type_check
def _refine(errors, count, bins, finer, kept_percent: tl.constexpr, BLOCK: tl.constexpr):
    """Counts the errors in the last bin that counts by their next bits."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = i < tl.load(count)
    last, _, _ = _found(bins, _kept(count, kept_percent))
    bits = tl.load(errors + i, mask=used, other=0.0).to(tl.int32, bitcast=True)
    tl.atomic_add(finer + ((bits >> NEXT) & (BINS - 1)), 1, mask=used & (bits >> FIRST == last), sem="relaxed")


@triton.jit
@no_type_check
def _sum(errors, count, bins, finer, partial, last, kept_percent: tl.constexpr, BLOCK: tl.constexpr):
    """A block's share of the mean. Writes to `last` the first 22 bits of the last error that counts, the weight of
    errors with these bits, and the number of errors that count."""
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    used, kept = i < tl.load(count), _kept(count, kept_percent)
    first, before, _ = _found(bins, kept)
    second, before_there, there = _found(finer, kept - before)
    limit = first * BINS + second
    share = (kept - before - before_there).to(tl.float32) / tl.maximum(there, 1).to(tl.float32)
    error = tl.load(errors + i, mask=used, other=0.0)
    weight = _weight(error, limit, share)
    total = tl.sum(tl.where(used & (weight > 0.0), weight * error, 0.0))
    tl.store(partial + block, total / kept.to(tl.float32))
    if block == 0:
        tl.store(last, limit.to(tl.float32))
        tl.store(last + 1, share)
        tl.store(last + 2, kept.to(tl.float32))


@triton.jit
@no_type_check
def _weight(error, limit, share):
    bits = error.to(tl.int32, bitcast=True) >> NEXT
    return tl.where(bits < limit, 1.0, tl.where(bits == limit, share, 0.0))


@triton.jit
@no_type_check
def _gradients(depth, pixels, measured, count, last, v_mean, v_depth, BLOCK: tl.constexpr):
    """Adds the gradients of depth."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    used = i < tl.load(count)
    at = tl.load(pixels + i, mask=used, other=0)
    off = tl.load(depth + at, mask=used, other=0.0) - tl.load(measured + i, mask=used, other=0.0)
    weight = _weight(tl.abs(off), tl.load(last).to(tl.int32), tl.load(last + 1))
    sign = tl.where(off > 0.0, 1.0, tl.where(off < 0.0, -1.0, 0.0))
    gradient = tl.load(v_mean) / tl.load(last + 2) * weight * sign
    tl.atomic_add(v_depth + at, gradient, mask=used & (gradient != 0.0), sem="relaxed")
