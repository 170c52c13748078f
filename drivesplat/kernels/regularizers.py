"""Means over Gaussians that regularizers penalise: opacity and scale (MCMC), and thickness."""

from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support


def mean_opacity_and_scale(
    opacities: Float[Tensor, " n"], scales: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The mean of `opacities`, and the mean of all `scales` (metres), where those of Gaussians with opacity 0 count
    as 0."""
    if len(opacities) and triton_support.usable_for(opacities):
        from drivesplat.kernels.triton.regularizers import MeanOpacityAndScale

        return MeanOpacityAndScale.apply(opacities, scales)
    present = opacities.detach() > 0.0
    return opacities.mean(), (scales * present[:, None]).mean()


def mean_thickness(scales: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean smallest scale in metres, 0 for disc-shaped Gaussians: the regularizer of NeuSG (Chen et al. 2023, arXiv
    2312.00846) and PGSR (Chen et al. 2024, arXiv 2406.06521)."""
    if len(scales) and triton_support.usable_for(scales):
        from drivesplat.kernels.triton.regularizers import MeanThickness

        return MeanThickness.apply(scales)
    return scales.min(dim=1).values.mean()
