"""What Gaussians send back to a LiDAR: intensity and the probability of a return, by the direction of the beam."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels import triton_support


def echo_values(
    echoes: Float[Tensor, "n 4 2"], means: Float[Tensor, "n 3"], sensor: Float[Tensor, "3"]
) -> Float[Tensor, "n 2"]:
    """Intensity and the probability of a return, both in [0, 1], of n Gaussians at `means` for a LiDAR at `sensor`
    (metres, world coordinates): the sigmoids of echoes[:, 0] + direction @ echoes[:, 1:], with the unit vector from the
    sensor to the Gaussian. Gradients reach `echoes` alone."""
    if triton_support.usable_for(echoes) and echoes.dtype == torch.float32:
        from drivesplat.kernels.triton.echoes import EchoValues

        return EchoValues.apply(echoes, means.detach(), sensor.detach())
    toward = normalize(means.detach() - sensor, dim=-1)
    along = (toward[:, :, None] * echoes[:, 1:]).sum(dim=1)  # a GPU multiplies small matrices slowly
    return torch.sigmoid(echoes[:, 0] + along)
