"""Fourier sums of objects' harmonics, rotated into the world, in one pass, and the gradient in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

COEFFICIENTS = 512
"""Harmonics per program."""


class ColorsInWorld(torch.autograd.Function):
    """`drivesplat.kernels.time_varying_colors.colors_in_world`; `series` and `rotations` are contiguous."""

    @staticmethod
    def forward(ctx: Any, sh0: Tensor, shN: Tensor, series: Tensor, rotations: Tensor, owner: Tensor) -> Tensor:
        count, terms, coefficients = len(sh0), sh0.shape[1], shN.shape[2] + 1
        colors = sh0.new_empty(count, coefficients, 3)
        _launch(_colors, sh0, shN, series, rotations, owner, colors, count, terms, coefficients)
        ctx.save_for_backward(series, rotations, owner)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        series, rotations, owner = ctx.saved_tensors
        v_colors = v_colors.contiguous()
        (count, coefficients, _), terms = v_colors.shape, series.shape[1]
        v_sh0 = v_colors.new_empty(count, terms, 1, 3)
        v_shN = v_colors.new_empty(count, terms, coefficients - 1, 3)
        _launch(_colors_backward, v_colors, series, rotations, owner, v_sh0, v_shN, count, terms, coefficients)
        return v_sh0, v_shN, None, None, None


def _launch(kernel: Any, *arguments: Any) -> None:
    """Runs a kernel over all Gaussians; its last three arguments are the numbers of Gaussians, of Fourier terms, and of
    coefficients."""
    *_, count, _, coefficients = arguments
    padded = triton.next_power_of_2(coefficients)
    block = COEFFICIENTS // padded
    kernel[(triton.cdiv(count, block),)](*arguments, padded, block)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors(
    sh0, shN, series, rotations, owner, colors, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, valid, object_, first, others, rotation = _harmonics(rotations, owner, count, K, PADDED, BLOCK)
    for channel in tl.static_range(3):
        own = tl.zeros((BLOCK, PADDED), tl.float32)
        for term in tl.static_range(TERMS):
            weight = tl.load(series + object_ * TERMS + term, mask=valid, other=0.0)[:, None]
            row = (i * TERMS + term)[:, None]
            of_first = tl.load(sh0 + row * 3 + channel + 0 * k[None, :], mask=first, other=0.0)
            of_others = tl.load(shN + (row * (K - 1) + k[None, :] - 1) * 3 + channel, mask=others, other=0.0)
            own += weight * (of_first + of_others)
        rotated = tl.sum(rotation * own[:, None, :], axis=2)
        tl.store(colors + (i[:, None] * K + k[None, :]) * 3 + channel, rotated, mask=first | others)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colors_backward(
    v_colors, series, rotations, owner, v_sh0, v_shN, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, valid, object_, first, others, rotation = _harmonics(rotations, owner, count, K, PADDED, BLOCK)
    for channel in tl.static_range(3):
        given = tl.load(v_colors + (i[:, None] * K + k[None, :]) * 3 + channel, mask=first | others, other=0.0)
        own = tl.sum(rotation * given[:, :, None], axis=1)
        for term in tl.static_range(TERMS):
            value = tl.load(series + object_ * TERMS + term, mask=valid, other=0.0)[:, None] * own
            row = (i * TERMS + term)[:, None]
            tl.store(v_sh0 + row * 3 + channel + 0 * k[None, :], value, mask=first)
            tl.store(v_shN + (row * (K - 1) + k[None, :] - 1) * 3 + channel, value, mask=others)


@triton.jit
@no_type_check
def _harmonics(rotations, owner, count, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr):
    """The Gaussians i and coefficients k of a program; which i exist, and their objects; the masks over i and k of the
    first and of the other coefficients; and the rotation matrices of the objects' harmonics."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    k = tl.arange(0, PADDED)
    valid = i < count
    object_ = tl.load(owner + i, mask=valid, other=0)
    first = valid[:, None] & (k == 0)[None, :]
    others = valid[:, None] & ((k > 0) & (k < K))[None, :]
    at = (object_[:, None, None] * K + k[None, :, None]) * K + k[None, None, :]
    known = valid[:, None, None] & (k < K)[None, :, None] & (k < K)[None, None, :]
    return i, k, valid, object_, first, others, tl.load(rotations + at, mask=known, other=0.0)
