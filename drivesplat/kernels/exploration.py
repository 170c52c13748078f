"""The noise with which MCMC's Gaussians explore (Kheradmand et al. 2024, equation 8)."""

from torch import nn

from drivesplat.kernels import triton_support


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
