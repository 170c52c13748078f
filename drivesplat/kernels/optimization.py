"""Steps of Adam (Kingma and Ba 2015, algorithm 1), and when values that a training watches are not finite."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import torch_private, triton_support

NEVER = 2**62


class AdamStep(NamedTuple):
    """A parameter with a gradient, the `state` of torch.optim.Adam, the learning rate, and what `adam_steps` sets to
    infinity for a gradient that is not finite."""

    parameter: Tensor
    state: dict[str, Tensor]
    rate: float | Float[Tensor, ""]
    broken: Float[Tensor, ""]


def adam_steps(steps: Sequence[AdamStep], betas: tuple[float, float], eps: float) -> list[Float[Tensor, ""]]:
    """Updates parameters by their gradients, and their states, as torch.optim.Adam does. Rates that are tensors are
    read on the device, without host synchronisation.

    Returns a value of each step that is finite only if the gradient and its square are. Triton's kernel, which reads
    the gradients anyway, sets `broken` to infinity where they are not, and the value is `broken`, which stays infinite.
    Otherwise it is the gradient's norm.
    """
    if steps and isinstance(steps[0].rate, Tensor) and triton_support.usable_for(steps[0].parameter):
        from drivesplat.kernels.triton.optimization import adam_steps as fused_steps

        moments = "exp_avg", "exp_avg_sq", "step"
        fused_steps(
            [(p, p.grad.contiguous(), *map(state.get, moments), rate, broken) for p, state, rate, broken in steps],
            betas,
            eps,
        )
        return [step.broken for step in steps]
    torch_private.increment([step.state["step"] for step in steps])
    norms = [torch.linalg.vector_norm(step.parameter.grad) for step in steps]
    for parameter, state, rate, _ in steps:
        torch_private.fused_adam_step(parameter, parameter.grad, state, rate, betas, eps)
    return norms


def record_not_finite(values: Float[Tensor, " k"], step: int | Int[Tensor, ""], first: Int[Tensor, " k"]) -> None:
    """Writes the smaller of `first` and `step` to `first`, in place, where a value is NaN or infinite."""
    if isinstance(step, Tensor) and triton_support.usable_for(values):
        from drivesplat.kernels.triton.optimization import record

        record(values, step, first)
        return
    torch.minimum(first, torch.where(torch.isfinite(values), NEVER, step), out=first)
