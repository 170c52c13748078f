"""What regularizers penalise: the mean opacity and scale (MCMC) and the thickness of Gaussians, and the corrections of
tracks."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.constants import constant


def mean_opacity_and_scale(
    *sets: tuple[Float[Tensor, " _"], Float[Tensor, "_ 3"]],
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


def sums_of_squares(
    shifts: Float[Tensor, "m 3"],
    yaw: Float[Tensor, " m"],
    neighbours: Int[Tensor, "q 3"],
    sigma_shift: float,
    sigma_yaw: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Of corrections of positions (metres) and headings (radians), in units of their sigmas: the sum of their squares,
    and that of their second differences, for which `neighbours` are all triples of consecutive annotations."""
    if triton_support.usable_for(yaw):
        from drivesplat.kernels.triton.track_penalties import SumsOfSquares

        return SumsOfSquares.apply(shifts, yaw, neighbours, 1.0 / sigma_shift, 1.0 / sigma_yaw)
    off = torch.cat([shifts, yaw[:, None]], dim=1) / constant((sigma_shift,) * 3 + (sigma_yaw,), yaw.device)
    threes = off.index_select(0, neighbours.flatten()).reshape(-1, 3, 4)
    bends = (threes * constant((1.0, -2.0, 1.0), yaw.device)[:, None]).sum(dim=1)
    return off.flatten().dot(off.flatten()), bends.flatten().dot(bends.flatten())
