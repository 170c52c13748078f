"""gsplat's private functions, each behind one function of ours. tests/kernels/test_private.py checks their signatures.

Import this module inside functions where gsplat may be missing.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from gsplat import DefaultStrategy
from gsplat.cuda._torch_impl import _eval_sh_bases_fast, _quat_scale_to_covar_preci
from gsplat.strategy import ops
from jaxtyping import Float, Int
from torch import Tensor, nn

from drivesplat.kernels.mcmc import relocation


def update_parameters(
    new_parameter: Callable[[str, Tensor], nn.Parameter],
    new_moments: Callable[[str, Tensor], Tensor],
    params: nn.ParameterDict,
    optimizers: Mapping[str, torch.optim.Optimizer],
) -> None:
    """Replaces every parameter by `new_parameter(name, value)` and its optimizer's moments by `new_moments(key,
    value)`."""
    ops._update_param_with_optimizer(new_parameter, new_moments, params, optimizers)


def sample_rows(weights: Float[Tensor, " n"], count: int) -> Int[Tensor, " count"]:
    """Draws `count` row numbers with replacement, with probabilities proportional to `weights`."""
    return ops._multinomial_sample(weights, count)


def sh_basis(coefficients: int, directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n k"]:
    """The first k = `coefficients` spherical harmonics along unit directions, in the order and with the signs of 3D
    Gaussian Splatting."""
    return _eval_sh_bases_fast(coefficients, directions)


def compiled_kernels() -> Any:
    """The module of gsplat's compiled CUDA kernels; None where they cannot be compiled. Raises what loading them
    raises."""
    from gsplat.cuda._backend import _C

    return _C


@contextmanager
def cpu_strategies() -> Iterator[None]:
    """Within this context gsplat's strategies run on the CPU: torch replaces the two CUDA kernels that they call."""
    with (
        patch.object(ops, "compute_relocation", relocation),
        patch.object(ops, "quat_scale_to_covar_preci", _quat_scale_to_covar_preci),
    ):
        yield


class HookedDefaultStrategy(DefaultStrategy):
    """gsplat's DefaultStrategy with a hook that runs just before it duplicates and splits Gaussians."""

    def before_growth(self, state: dict[str, Any]) -> None:
        """May change the gradient statistics in `state` that decide which Gaussians grow."""

    @torch.no_grad()
    def _grow_gs(self, params: Any, optimizers: Any, state: dict[str, Any], step: int) -> tuple[int, int]:
        self.before_growth(state)
        return super()._grow_gs(params, optimizers, state, step)
