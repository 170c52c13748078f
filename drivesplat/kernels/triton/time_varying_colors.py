"""Fourier sums of objects' harmonics, rotated into the world, in one pass, and the gradient in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

PRODUCTS = 2048
"""Products of a coefficient and a rotation's entry per program."""


class ColorsInWorld(torch.autograd.Function):
    """`drivesplat.kernels.placement.colors_in_world`; `series` and `rotations` are contiguous."""

    @staticmethod
    def forward(
        ctx: Any, sh0: Tensor, shN: Tensor, series: Tensor, rotations: Tensor, owner: Tensor
    ) -> tuple[Tensor, Tensor]:
        count, terms, coefficients = len(sh0), sh0.shape[1], shN.shape[2] + 1
        first, others = sh0.new_empty(count, 1, 3), sh0.new_empty(count, coefficients - 1, 3)
        _launch(_colors, sh0, shN, series, rotations, owner, first, others, count, terms, coefficients)
        ctx.save_for_backward(series, rotations, owner)
        return first, others

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_first: Tensor, v_others: Tensor) -> tuple[Tensor | None, ...]:
        series, rotations, owner = ctx.saved_tensors
        v_first, v_others = v_first.contiguous(), v_others.contiguous()
        (count, above, _), terms = v_others.shape, series.shape[1]
        v_sh0, v_shN = v_first.new_empty(count, terms, 1, 3), v_first.new_empty(count, terms, above, 3)
        given = (v_first, v_others, series, rotations, owner)
        _launch(_colors_backward, *given, v_sh0, v_shN, count, terms, above + 1)
        return v_sh0, v_shN, None, None, None


def _launch(kernel: Any, *arguments: Any) -> None:
    """Runs a kernel over all Gaussians; its last three arguments are the numbers of Gaussians, of Fourier terms, and of
    coefficients."""
    *_, count, _, coefficients = arguments
    padded = triton.next_power_of_2(coefficients)
    block = PRODUCTS // (4 * padded**2)
    kernel[(triton.cdiv(count, block),)](*arguments, padded, block)


# Neighbouring threads have neighbouring color channels, padded from 3 to 4, then neighbouring coefficients: they read
# and write whole rows of memory.


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors(
    sh0, shN, series, rotations, owner, first_colors, other_colors, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, channel, object_, first, others, rotation = _harmonics(rotations, owner, count, K, PADDED, BLOCK)
    own = tl.zeros((BLOCK, PADDED, 4), tl.float32)
    for term in tl.static_range(TERMS):
        weight = tl.load(series + object_ * TERMS + term, mask=i < count, other=0.0)[:, None, None]
        of_first, of_others = _places(sh0, shN, i * TERMS + term, k, channel, K)
        own += weight * (tl.load(of_first, mask=first, other=0.0) + tl.load(of_others, mask=others, other=0.0))
    rotated = tl.sum(rotation * own[:, None, :, :], axis=2)
    of_first, of_others = _places(first_colors, other_colors, i, k, channel, K)
    tl.store(of_first, rotated, mask=first)
    tl.store(of_others, rotated, mask=others)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors_backward(
    v_first, v_others, series, rotations, owner, v_sh0, v_shN, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, channel, object_, first, others, rotation = _harmonics(rotations, owner, count, K, PADDED, BLOCK)
    of_first, of_others = _places(v_first, v_others, i, k, channel, K)
    given = tl.load(of_first, mask=first, other=0.0) + tl.load(of_others, mask=others, other=0.0)
    own = tl.sum(rotation * given[:, :, None, :], axis=1)
    for term in tl.static_range(TERMS):
        value = tl.load(series + object_ * TERMS + term, mask=i < count, other=0.0)[:, None, None] * own
        of_first, of_others = _places(v_sh0, v_shN, i * TERMS + term, k, channel, K)
        tl.store(of_first, value, mask=first)
        tl.store(of_others, value, mask=others)


@triton.jit
@no_type_check
def _harmonics(rotations, owner, count, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr):
    """The Gaussians i, coefficients k and color channels of a program; the Gaussians' objects; the masks over i, k and
    channels of the first and of the other coefficients; and the rotation matrices of the objects' harmonics, with a
    last axis of length 1."""
    i, k, channel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, PADDED), tl.arange(0, 4)
    object_ = tl.load(owner + i, mask=i < count, other=0)
    known = (i < count)[:, None, None] & (k < K)[None, :, None]
    exists, is_first = known & (channel < 3)[None, None, :], (k == 0)[None, :, None]
    at = (object_[:, None, None] * K + k[None, :, None]) * K + k[None, None, :]
    rotation = tl.load(rotations + at, mask=known & (k < K)[None, None, :], other=0.0)
    return i, k, channel, object_, exists & is_first, exists & ~is_first, rotation[:, :, :, None]


@triton.jit
@no_type_check
def _place(colors, row, k, channel, K: tl.constexpr):
    """Where coefficients k, of K, of rows stand."""
    return colors + (row[:, None, None] * K + k[None, :, None]) * 3 + channel[None, None, :]


@triton.jit
@no_type_check
def _places(sh0, shN, row, k, channel, K: tl.constexpr):
    """Where the first and the other coefficients of rows stand."""
    return _place(sh0, row, 0 * k, channel, 1), _place(shN, row, k - 1, channel, K - 1)
