"""What Gaussians send back to a LiDAR: intensity and the probability of a return, by the direction of the beam."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels import triton_support


def lidar_response(
    logits: Float[Tensor, "n 4 2"], means: Float[Tensor, "n 3"], sensor: Float[Tensor, "3"]
) -> Float[Tensor, "n 2"]:
    """Intensity and the probability of a return, both in [0, 1], of n Gaussians at `means` for a LiDAR at `sensor`
    (metres, world coordinates): the sigmoids of logits[:, 0] + direction @ logits[:, 1:], with the unit vector from the
    sensor to the Gaussian. Gradients reach `logits` alone."""
    if triton_support.usable_for(logits) and logits.dtype == torch.float32:
        from drivesplat.kernels.triton.lidar_response import LidarResponse

        return LidarResponse.apply(logits, means.detach(), sensor.detach())
    toward = normalize(means.detach() - sensor, dim=-1)
    along = (toward[:, :, None] * logits[:, 1:]).sum(dim=1)  # a GPU multiplies small matrices slowly
    return torch.sigmoid(logits[:, 0] + along)
