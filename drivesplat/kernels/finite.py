"""When values that a training watches are not finite for the first time."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support

NEVER = 2**62


def record_not_finite(values: Float[Tensor, " k"], step: int | Int[Tensor, ""], first: Int[Tensor, " k"]) -> None:
    """Writes the smaller of `first` and `step` to `first`, in place, where a value is NaN or infinite."""
    if isinstance(step, Tensor) and triton_support.usable_for(values):
        from drivesplat.kernels.triton.finite import record

        record(values, step, first)
        return
    torch.minimum(first, torch.where(torch.isfinite(values), NEVER, step), out=first)
