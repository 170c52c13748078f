"""Means over Gaussians that regularizers penalise: opacity and scale (MCMC), and thickness."""

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support


def mean_opacity_and_scale(
    *sets: tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The mean opacity, and the mean of all scales (metres), where those of Gaussians with opacity 0 count as 0, over
    the Gaussians of some sets; of each its opacities and scales are given."""
    if any(len(own) for own, _ in sets) and triton_support.usable_for(sets[0][0]):
        from drivesplat.kernels.triton.regularizers import MeanOpacityAndScale

        return MeanOpacityAndScale.apply(*(values for own in sets for values in own))
    opacities, scales = sets[0] if len(sets) == 1 else map(torch.cat, zip(*sets, strict=True))
    present = opacities.detach() > 0.0
    return opacities.mean(), (scales * present[:, None]).mean()


def mean_thickness(scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean smallest scale in metres, 0 for disc-shaped Gaussians: the regularizer of NeuSG (Chen et al. 2023, arXiv
    2312.00846) and PGSR (Chen et al. 2024, arXiv 2406.06521)."""
    if len(scales) and triton_support.usable_for(scales):
        from drivesplat.kernels.triton.regularizers import MeanThickness

        return MeanThickness.apply(scales)
    return scales.min(dim=1).values.mean()
