"""Objects' colours at a time, turned with them, in one pass, and the gradient in another."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

VALUES = 512
"""Harmonics a program."""


def turned_colours(
    sh0: Float[Tensor, "n f 1 3"],
    shN: Float[Tensor, "n f k_less_1 3"],
    series: Float[Tensor, "a f"],
    turns: Float[Tensor, "a k k"],
    owner: Int[Tensor, " n"],
) -> Float[Tensor, "n k 3"]:
    """The harmonics of n Gaussians in the world: the sum of their Fourier coefficients by `series`, then turned by the
    maps `turns`, both of their objects. There are gradients for `sh0` and `shN`."""
    return _TurnedColours.apply(sh0, shN, series.contiguous(), turns.contiguous(), owner)


class _TurnedColours(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh0: Tensor, shN: Tensor, series: Tensor, turns: Tensor, owner: Tensor) -> Tensor:
        count, terms, coefficients = len(sh0), sh0.shape[1], shN.shape[2] + 1
        colours = sh0.new_empty(count, coefficients, 3)
        _launch(_colours, sh0, shN, series, turns, owner, colours, count, terms, coefficients)
        ctx.save_for_backward(series, turns, owner)
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colours: Tensor) -> tuple[Tensor | None, ...]:
        series, turns, owner = ctx.saved_tensors
        v_colours = v_colours.contiguous()
        (count, coefficients, _), terms = v_colours.shape, series.shape[1]
        v_sh0 = v_colours.new_empty(count, terms, 1, 3)
        v_shN = v_colours.new_empty(count, terms, coefficients - 1, 3)
        _launch(_colours_back, v_colours, series, turns, owner, v_sh0, v_shN, count, terms, coefficients)
        return v_sh0, v_shN, None, None, None


def _launch(kernel: Any, *told: Any) -> None:
    """A kernel over all Gaussians; the last three that it is told are how many there are, their Fourier terms, and
    their coefficients."""
    *_, count, _, coefficients = told
    padded = triton.next_power_of_2(coefficients)
    block = VALUES // padded
    kernel[(triton.cdiv(count, block),)](*told, padded, block)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colours(
    sh0, shN, series, turns, owner, colours, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, there, whose, first, others, turn = _harmonics(turns, owner, count, K, PADDED, BLOCK)
    for channel in tl.static_range(3):
        own = tl.zeros((BLOCK, PADDED), tl.float32)
        for term in tl.static_range(TERMS):
            weight = tl.load(series + whose * TERMS + term, mask=there, other=0.0)[:, None]
            row = (i * TERMS + term)[:, None]
            of_first = tl.load(sh0 + row * 3 + channel + 0 * k[None, :], mask=first, other=0.0)
            of_others = tl.load(shN + (row * (K - 1) + k[None, :] - 1) * 3 + channel, mask=others, other=0.0)
            own += weight * (of_first + of_others)
        turned = tl.sum(turn * own[:, None, :], axis=2)
        tl.store(colours + (i[:, None] * K + k[None, :]) * 3 + channel, turned, mask=first | others)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _colours_back(
    v_colours, series, turns, owner, v_sh0, v_shN, count,
    TERMS: tl.constexpr, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i, k, there, whose, first, others, turn = _harmonics(turns, owner, count, K, PADDED, BLOCK)
    for channel in tl.static_range(3):
        given = tl.load(v_colours + (i[:, None] * K + k[None, :]) * 3 + channel, mask=first | others, other=0.0)
        own = tl.sum(turn * given[:, :, None], axis=1)
        for term in tl.static_range(TERMS):
            value = tl.load(series + whose * TERMS + term, mask=there, other=0.0)[:, None] * own
            row = (i * TERMS + term)[:, None]
            tl.store(v_sh0 + row * 3 + channel + 0 * k[None, :], value, mask=first)
            tl.store(v_shN + (row * (K - 1) + k[None, :] - 1) * 3 + channel, value, mask=others)


@triton.jit
@no_type_check
def _harmonics(turns, owner, count, K: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr):
    """The Gaussians i and coefficients k of a program; which i there are and whose they are; where of i and k the first
    and the other coefficients are; and the maps of the Gaussians' objects."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    k = tl.arange(0, PADDED)
    there = i < count
    whose = tl.load(owner + i, mask=there, other=0)
    first = there[:, None] & (k == 0)[None, :]
    others = there[:, None] & ((k > 0) & (k < K))[None, :]
    at = (whose[:, None, None] * K + k[None, :, None]) * K + k[None, None, :]
    known = there[:, None, None] & (k < K)[None, :, None] & (k < K)[None, None, :]
    return i, k, there, whose, first, others, tl.load(turns + at, mask=known, other=0.0)
