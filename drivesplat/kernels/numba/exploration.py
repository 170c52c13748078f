"""The noise with which MCMC's Gaussians explore (Kheradmand et al. 2024, equation 8), in one pass."""

import math
from typing import no_type_check

import torch
from torch import nn

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.threads import parallel_for

STEEPNESS, MIDPOINT = 100.0, 0.005
"""Parameters of the logistic function by which the noise decreases with opacity, as in gsplat."""
CHUNK = 4096
"""Gaussians per chunk."""


@torch.no_grad()
def explore(params: nn.ParameterDict, strength: float) -> None:
    """See `drivesplat.kernels.mcmc.explore`; all random numbers are drawn from torch's global generator."""
    means, noise = params["means"], torch.randn_like(params["means"])
    shapes = arrays(params["quats"], params["scales"], params["opacities"])
    parallel_for(_move, len(means), CHUNK, means.numpy(), noise.numpy(), *shapes, strength)


@kernel
@no_type_check
def _move(start, stop, means, noise, quats, log_scales, logits, strength):
    """Adds to each mean its covariance times the noise, which decreases with opacity."""
    for i in range(start, stop):
        opacity = 1 / (1 + math.exp(-logits[i]))
        length = strength / (1 + math.exp(STEEPNESS * (opacity - MIDPOINT)))
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        norm = 1 / math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w * norm, x * norm, y * norm, z * norm
        axes = (
            (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
            (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
            (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
        )
        for j in range(3):
            axis = axes[j]
            along = axis[0] * noise[i, 0] + axis[1] * noise[i, 1] + axis[2] * noise[i, 2]
            along *= length * math.exp(2 * log_scales[i, j])
            for k in range(3):
                means[i, k] += axis[k] * along
