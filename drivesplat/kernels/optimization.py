"""One step of Adam (Kingma and Ba 2015, algorithm 1), and when values that a training watches are not finite."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import torch_private, triton_support

NEVER = 2**62


def adam_step(
    parameter: Float[Tensor, "*n"],
    state: dict[str, Tensor],
    rate: float | Float[Tensor, ""],
    betas: tuple[float, float],
    eps: float,
    broken: Float[Tensor, ""],
) -> Float[Tensor, ""]:
    """Updates a parameter by its gradient, as torch.optim.Adam does with its `state`, whose step is already
    incremented. A `rate` that is a tensor is read on the device, without host synchronisation.

    Returns a value that is finite only if the gradient and its square are. Triton's kernel, which reads the gradient
    anyway, sets `broken` to infinity where they are not, and returns `broken`, which stays infinite. Otherwise the
    value is the gradient's norm.
    """
    if isinstance(rate, Tensor) and triton_support.usable_for(parameter):
        from drivesplat.kernels.triton.optimization import adam_step as fused_step

        fused_step(parameter, parameter.grad, state, rate, betas, eps, broken)
        return broken
    norm = torch.linalg.vector_norm(parameter.grad)
    torch_private.fused_adam_step(parameter, parameter.grad, state, rate, betas, eps)
    return norm


def record_not_finite(values: Float[Tensor, " k"], step: int | Int[Tensor, ""], first: Int[Tensor, " k"]) -> None:
    """Writes the smaller of `first` and `step` to `first`, in place, where a value is NaN or infinite."""
    if isinstance(step, Tensor) and triton_support.usable_for(values):
        from drivesplat.kernels.triton.optimization import record

        record(values, step, first)
        return
    torch.minimum(first, torch.where(torch.isfinite(values), NEVER, step), out=first)
