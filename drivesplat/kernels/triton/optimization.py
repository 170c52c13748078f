"""One step of Adam (Kingma and Ba 2015, algorithm 1), limited by memory bandwidth alone, and the first iterations at
which values were not finite, in one kernel each."""

import math
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

BLOCK = 1024
"""Values per program."""
WATCHED_BLOCK = 128
"""Watched values per program."""


@torch.no_grad()
def adam_step(
    parameter: Float[Tensor, "*n"],
    gradient: Float[Tensor, "*n"],
    state: dict[str, Tensor],
    rate: Float[Tensor, ""],
    betas: tuple[float, float],
    eps: float,
    broken: Float[Tensor, ""],
) -> None:
    """See `drivesplat.kernels.optimization.adam_step`; `gradient` is the parameter's."""
    count = parameter.numel()
    if count == 0:
        return
    beta1, beta2 = betas
    _step[(triton.cdiv(count, BLOCK),)](
        parameter, gradient.contiguous(), state["exp_avg"], state["exp_avg_sq"], state["step"], rate, count,
        beta1, 1.0 - beta1, math.log(beta1), beta2, 1.0 - beta2, math.log(beta2), eps, broken, BLOCK,
    )  # fmt: skip


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _step(
    values, gradients, averages, squares, counted, rate, count, beta1, rest1, log_beta1, beta2, rest2, log_beta2, eps,
    broken, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    done = tl.load(counted).to(tl.float64)
    size = (tl.load(rate) / (1.0 - tl.exp(done * log_beta1))).to(tl.float32)
    spread = tl.sqrt(1.0 - tl.exp(done * log_beta2)).to(tl.float32)
    gradient = tl.load(gradients + i, mask=inside, other=0.0)
    average = beta1 * tl.load(averages + i, mask=inside, other=0.0) + rest1 * gradient
    square = beta2 * tl.load(squares + i, mask=inside, other=0.0) + rest2 * gradient * gradient
    infinite = tl.full((BLOCK,), float("inf"), tl.float32)
    tl.store(broken + tl.zeros((BLOCK,), tl.int32), infinite, mask=inside & ~(square < infinite))
    value = tl.load(values + i, mask=inside, other=0.0)
    tl.store(averages + i, average, mask=inside)
    tl.store(squares + i, square, mask=inside)
    tl.store(values + i, value - size * average / (tl.sqrt(square) / spread + eps), mask=inside)


def record(values: Tensor, step: Tensor, first: Tensor) -> None:
    """`drivesplat.kernels.optimization.record_not_finite`, with `step` on the device."""
    _record[(triton.cdiv(len(values), WATCHED_BLOCK),)](values, step, first, len(values), WATCHED_BLOCK)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _record(values, step, first, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = tl.load(first + i, mask=i < count, other=0)
    finite = tl.abs(tl.load(values + i, mask=i < count, other=0.0)) < float("inf")  # false for NaN, too
    tl.store(first + i, tl.where(finite, known, tl.minimum(known, tl.load(step))), mask=i < count)
