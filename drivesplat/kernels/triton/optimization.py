"""Steps of Adam (Kingma and Ba 2015, algorithm 1) of several parameters, limited by memory bandwidth alone, and the
first iterations at which values were not finite, in one kernel each."""

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
"""Parameters per launch. Where there are fewer, places stay empty: one compiled kernel serves every model."""
WATCHED_BLOCK = 128
"""Watched values per program."""


@torch.no_grad()
def adam_steps(steps: Sequence[tuple[Tensor, ...]], betas: tuple[float, float], eps: float) -> None:
    """See `drivesplat.kernels.optimization.adam_steps`. A step has the parameter, its contiguous gradient, `exp_avg`,
    `exp_avg_sq`, `step`, the rate, and `broken`."""
    beta1, beta2 = betas
    for at in range(0, len(steps), TOGETHER):
        group = steps[at : at + TOGETHER]
        empty = TOGETHER - len(group)
        pointers = list(zip(*group, *group[:1] * empty, strict=True))
        _count[(1,)](pointers[4], len(group), TOGETHER)
        counts = [step[0].numel() for step in group]
        programs = sum(triton.cdiv(count, BLOCK) for count in counts)
        if programs:
            _step[(programs,)](
                *pointers, *counts, *[0] * empty,
                beta1, 1.0 - beta1, math.log(beta1), beta2, 1.0 - beta2, math.log(beta2), eps, BLOCK,
            )  # fmt: skip


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _count(counted, count, TOGETHER: tl.constexpr):
    """Adds 1 to each of the first `count`."""
    for k in tl.static_range(TOGETHER):
        if k < count:
            tl.store(counted[k], tl.load(counted[k]) + 1.0)


# Counts are arguments of their own: Triton would compile a kernel for each divisibility of an integer in a tuple.


@triton.jit(do_not_specialize=[f"count{k}" for k in range(TOGETHER)])
@no_type_check
def _step(
    values, gradients, averages, squares, counted, rates, broken,
    count0, count1, count2, count3, count4, count5, count6, count7,
    beta1, rest1, log_beta1, beta2, rest2, log_beta2, eps, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of values of one of the parameters, whose blocks follow one another."""
    counts = (count0, count1, count2, count3, count4, count5, count6, count7)
    first = (tl.program_id(0) - _first_program(counts, BLOCK)).to(tl.int64) * BLOCK
    rest = _of_program(counts, counts, BLOCK) - first
    done = tl.load(_of_program(counted, counts, BLOCK)).to(tl.float64)
    rate = tl.load(_of_program(rates, counts, BLOCK))
    size = (rate / (1.0 - tl.exp(done * log_beta1))).to(tl.float32)
    spread = tl.sqrt(1.0 - tl.exp(done * log_beta2)).to(tl.float32)
    values, gradients = _of_program(values, counts, BLOCK) + first, _of_program(gradients, counts, BLOCK) + first
    averages, squares = _of_program(averages, counts, BLOCK) + first, _of_program(squares, counts, BLOCK) + first
    broken, i = _of_program(broken, counts, BLOCK), tl.arange(0, BLOCK)
    if rest >= BLOCK:  # without a mask, threads read four values at once
        inside = tl.full((BLOCK,), 1, tl.int1)
        _update(values, gradients, averages, squares, broken, i, inside, size, spread, beta1, rest1, beta2, rest2, eps)
    else:
        inside = i < rest
        _update(values, gradients, averages, squares, broken, i, inside, size, spread, beta1, rest1, beta2, rest2, eps)


@triton.jit
@no_type_check
def _update(values, gradients, averages, squares, broken, i, inside, size, spread, beta1, rest1, beta2, rest2, eps):
    """Updates the values at `i` that are `inside`."""
    gradient = tl.load(gradients + i, mask=inside, other=0.0)
    average = beta1 * tl.load(averages + i, mask=inside, other=0.0) + rest1 * gradient
    square = beta2 * tl.load(squares + i, mask=inside, other=0.0) + rest2 * gradient * gradient
    infinite = tl.full(i.shape, float("inf"), tl.float32)
    tl.store(broken + i * 0, infinite, mask=inside & ~(square < infinite))
    value = tl.load(values + i, mask=inside, other=0.0)
    tl.store(averages + i, average, mask=inside)
    tl.store(squares + i, square, mask=inside)
    tl.store(values + i, value - size * average / (tl.sqrt(square) / spread + eps), mask=inside)


@triton.jit
@no_type_check
def _of_program(entries, counts, BLOCK: tl.constexpr):
    """The entry of the parameter whose values this program updates."""
    found, end = entries[0], tl.cdiv(counts[0], BLOCK)
    for k in tl.static_range(1, len(entries)):
        found = tl.where(tl.program_id(0) >= end, entries[k], found)
        end += tl.cdiv(counts[k], BLOCK)
    return found


@triton.jit
@no_type_check
def _first_program(counts, BLOCK: tl.constexpr):
    """The first of the programs that update the same parameter."""
    first, end = 0, tl.cdiv(counts[0], BLOCK)
    for k in tl.static_range(1, len(counts)):
        first = tl.where(tl.program_id(0) >= end, end, first)
        end += tl.cdiv(counts[k], BLOCK)
    return first


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
