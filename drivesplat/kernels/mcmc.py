"""What MCMC (Kheradmand et al. 2024) does to Gaussians: relocation (equation 9) and the noise with which they explore
(equation 8)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from drivesplat.kernels import triton_support


def relocation(
    opacities: Float[Tensor, " n"],
    scales: Float[Tensor, "n 3"],
    ratios: Int[Tensor, " n"],
    binoms: Float[Tensor, "n_max n_max"],
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Opacity (in [0, 1]) and scale (metres) with which `ratios` coincident copies look like the original Gaussian.

    `binoms[i, k]` is the binomial coefficient. The arguments are those of gsplat's `compute_relocation`, which runs on
    a GPU; elsewhere torch runs.
    """
    if opacities.is_cuda:
        from gsplat.relocation import compute_relocation

        return compute_relocation(opacities, scales, ratios, binoms)
    n_max = len(binoms)
    ratios = ratios.clamp(1, n_max).long()
    new_opacities = 1.0 - (1.0 - opacities) ** (1.0 / ratios)
    k = torch.arange(n_max, device=opacities.device, dtype=torch.float64)  # the terms alternate and reach 1e14
    series = (-1.0) ** k / torch.sqrt(k + 1.0) * new_opacities[:, None].double() ** (k + 1)
    # sum over i < ratio of sum over k <= i of binom(i, k) * series_k; binom(i, k) = 0 beyond k = i
    coefficients = torch.cumsum(binoms.double(), dim=0)[ratios - 1]
    shrink = opacities / (coefficients * series).sum(dim=1).to(opacities.dtype)
    return new_opacities, shrink[:, None] * scales


def explore(params: nn.ParameterDict, strength: float) -> None:
    """Moves `means` (n, 3) at random, as gsplat's `inject_noise_to_position` does: along each Gaussian's own extent,
    and the farther the lower its opacity.

    `quats` (n, 4), log `scales` (n, 3) and `opacities` (n,), logits, give the distribution, `strength` its factor. The
    random numbers follow from torch's global generator.
    """
    if triton_support.usable_for(params["means"]):
        from drivesplat.kernels.triton.exploration import explore as move
    elif params["means"].is_cuda:
        from gsplat.strategy.ops import inject_noise_to_position

        inject_noise_to_position(params, {}, {}, strength)
        return
    else:
        from drivesplat.kernels.numba.exploration import explore as move
    move(params, strength)
