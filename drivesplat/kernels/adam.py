"""One step of Adam (Kingma and Ba 2015, algorithm 1)."""

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import torch_private, triton_support


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

    Returns a value that is finite only if the gradient is: its norm, or `broken`, which a gradient that is not finite
    sets to infinity. A norm would read all gradients once more.
    """
    if isinstance(rate, Tensor) and triton_support.usable_for(parameter):
        from drivesplat.kernels.triton.adam import adam_step as fused_step

        fused_step(parameter, parameter.grad, state, rate, betas, eps, broken)
        return broken
    norm = torch.linalg.vector_norm(parameter.grad)
    torch_private.fused_adam_step(parameter, parameter.grad, state, rate, betas, eps)
    return norm
