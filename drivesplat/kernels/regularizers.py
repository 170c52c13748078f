"""The mean opacity and mean scale, which the MCMC strategy's regularizers penalise."""

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
