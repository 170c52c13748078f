"""Spherical harmonics that vary with time as a Fourier series, and rotate with their object."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.placement import of_owners


def colors_in_world(
    sh0: Float[Tensor, "n f 1 3"],
    shN: Float[Tensor, "n f k_less_1 3"],
    series: Float[Tensor, "a f"],
    rotations: Float[Tensor, "a k k"],
    owner: Int[Tensor, " n"],
    owns: Float[Tensor, "n a"],
) -> tuple[Float[Tensor, "n 1 3"], Float[Tensor, "n k_less_1 3"]]:
    """The harmonics of n Gaussians in the world, those of degree 0 and those above: `colors_in_object`, mapped by
    `rotations` of their object's harmonics. `owner` is the object of every Gaussian, `owns` the same as a one-hot
    matrix. Gradients reach `sh0` and `shN`."""
    if triton_support.usable_for(sh0):
        from drivesplat.kernels.triton.time_varying_colors import ColorsInWorld

        return ColorsInWorld.apply(sh0, shN, series.contiguous(), rotations.contiguous(), owner)
    sh = colors_in_object(sh0, shN, series, owns)
    turned = of_owners(rotations, owns) @ sh if sh.shape[1] > 1 else sh
    return turned[:, :1], turned[:, 1:]


def colors_in_object(
    sh0: Float[Tensor, "n f 1 3"],
    shN: Float[Tensor, "n f k_less_1 3"],
    series: Float[Tensor, "a f"],
    owns: Float[Tensor, "n a"],
) -> Float[Tensor, "n k 3"]:
    """The harmonics of n Gaussians in their objects' frames: their f Fourier coefficients summed with the weights
    `series` of their object, the first of which is 1."""
    coefficients = torch.cat([sh0, shN], dim=2)
    if coefficients.shape[1] == 1:
        return coefficients[:, 0]
    return (of_owners(series, owns)[:, :, None, None] * coefficients).sum(dim=1)
