"""The first iterations at which values were not finite, in one kernel."""

from typing import no_type_check

import triton
import triton.language as tl
from torch import Tensor

BLOCK = 128
"""Values per program."""


def record(values: Tensor, step: Tensor, first: Tensor) -> None:
    """`drivesplat.kernels.finite.record_not_finite`, with `step` on the device."""
    _record[(triton.cdiv(len(values), BLOCK),)](values, step, first, len(values), BLOCK)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _record(values, step, first, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = tl.load(first + i, mask=i < count, other=0)
    finite = tl.abs(tl.load(values + i, mask=i < count, other=0.0)) < float("inf")  # false for NaN, too
    tl.store(first + i, tl.where(finite, known, tl.minimum(known, tl.load(step))), mask=i < count)
