"""The noise with which MCMC's Gaussians explore (Kheradmand et al. 2024, equation 8), in one pass."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import nn

from drivesplat.kernels.triton.rows import store_three, three, unit

STEEPNESS = tl.constexpr(100.0)
MIDPOINT = tl.constexpr(0.005)
"""Parameters of the logistic function by which the noise decreases with opacity, as in gsplat."""
BLOCK = 256
"""Gaussians per program."""
SEEDS = 2**31
"""The number of different seeds of the noise."""


@torch.no_grad()
def explore(params: nn.ParameterDict, strength: float) -> None:
    """See `drivesplat.kernels.mcmc.explore`; only a seed is drawn from torch's global generator."""
    names = ("means", "quats", "scales", "opacities")
    means, quats, scales, opacities = (params[name] for name in names)
    seed = int(torch.randint(SEEDS, ()))
    _move[(triton.cdiv(len(means), BLOCK),)](means, quats, scales, opacities, strength, seed, len(means), BLOCK)


@triton.jit
@no_type_check
def _along(axis_x, axis_y, axis_z, x, y, z, length):
    """A vector's component along a unit axis, times a length."""
    share = (axis_x * x + axis_y * y + axis_z * z) * length
    return axis_x * share, axis_y * share, axis_z * share


@triton.jit(do_not_specialize=["seed", "count"])
@no_type_check
def _move(means, quats, log_scales, logits, strength, seed, count, BLOCK: tl.constexpr):
    """Adds to each mean its covariance times the noise, which decreases with opacity."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    opacity = tl.sigmoid(tl.load(logits + i, mask=valid, other=0.0))
    length = strength * tl.sigmoid(STEEPNESS * (MIDPOINT - opacity))
    w, x, y, z, _ = unit(quats, i, valid)
    noise_x, noise_y, noise_z, _ = tl.randn4x(seed, i)
    size_0, size_1, size_2 = three(log_scales, i, valid)
    length_0, length_1 = length * tl.exp(2.0 * size_0), length * tl.exp(2.0 * size_1)
    length_2 = length * tl.exp(2.0 * size_2)
    x_0, y_0, z_0 = _along(
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), noise_x, noise_y, noise_z, length_0
    )
    x_1, y_1, z_1 = _along(
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), noise_x, noise_y, noise_z, length_1
    )
    x_2, y_2, z_2 = _along(
        2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), noise_x, noise_y, noise_z, length_2
    )
    x, y, z = three(means, i, valid)
    store_three(means, i, x + x_0 + x_1 + x_2, y + y_0 + y_1 + y_2, z + z_0 + z_1 + z_2, valid)
