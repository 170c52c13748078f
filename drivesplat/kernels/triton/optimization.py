"""Steps of Adam (Kingma and Ba 2015, algorithm 1) of several parameters, limited by memory bandwidth alone, and the first
iterations at which values were not finite, in one kernel each."""

import math
from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024
"""Values per program."""
TOGETHER = 8
"""Parameters per launch: fewer leave places empty, so that one compiled kernel serves every model."""
WATCHED_BLOCK = 128
"""Watched values per program."""


@torch.no_grad()
def adam_steps(steps: Sequence[tuple[Tensor, ...]], betas: tuple[float, float], eps: float) -> None:
    """See `drivesplat.kernels.optimization.adam_steps`. A step has the parameter, its contiguous gradient, `exp_avg`,
    `exp_avg_sq`, `step`, the rate, and `broken`."""
    steps = [step for step in steps if step[0].numel()]
    beta1, beta2 = betas
    for at in range(0, len(steps), TOGETHER):
        group = steps[at : at + TOGETHER]
        counts = [step[0].numel() for step in group]
        empty = TOGETHER - len(group)
        _step[(sum(triton.cdiv(count, BLOCK) for count in counts),)](
            *zip(*group, *group[:1] * empty, strict=True), (*counts, *[0] * empty),
            beta1, 1.0 - beta1, math.log(beta1), beta2, 1.0 - beta2, math.log(beta2), eps, TOGETHER, BLOCK,
        )  # fmt: skip


@triton.jit(do_not_specialize=["counts"])
@no_type_check
def _step(
    values, gradients, averages, squares, counted, rates, broken, counts, beta1, rest1, log_beta1, beta2, rest2,
    log_beta2, eps, TOGETHER: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of values of one parameter; those of the first come first."""
    block = tl.program_id(0)
    for k in tl.static_range(TOGETHER):
        blocks = tl.cdiv(counts[k], BLOCK)
        if (block >= 0) & (block < blocks):
            i = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
            inside = i < counts[k]
            done = tl.load(counted[k]).to(tl.float64)
            size = (tl.load(rates[k]) / (1.0 - tl.exp(done * log_beta1))).to(tl.float32)
            spread = tl.sqrt(1.0 - tl.exp(done * log_beta2)).to(tl.float32)
            gradient = tl.load(gradients[k] + i, mask=inside, other=0.0)
            average = beta1 * tl.load(averages[k] + i, mask=inside, other=0.0) + rest1 * gradient
            square = beta2 * tl.load(squares[k] + i, mask=inside, other=0.0) + rest2 * gradient * gradient
            infinite = tl.full((BLOCK,), float("inf"), tl.float32)
            tl.store(broken[k] + tl.zeros((BLOCK,), tl.int32), infinite, mask=inside & ~(square < infinite))
            value = tl.load(values[k] + i, mask=inside, other=0.0)
            tl.store(averages[k] + i, average, mask=inside)
            tl.store(squares[k] + i, square, mask=inside)
            tl.store(values[k] + i, value - size * average / (tl.sqrt(square) / spread + eps), mask=inside)
        block -= blocks


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
