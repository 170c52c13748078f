"""The distance from the world's origin within which Gaussians lie; what is farther away is the sky's."""

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.part import Part

INSIDE = 1.0 - 1e-5
"""The share of the distance up to which positions are moved, so that they stay within it despite rounding."""


def reach_of(sensors: Float[Tensor, "n 3"], max_distance: float) -> float:
    """The distance (metres) from the world's origin within which Gaussians lie: `max_distance`, or on a long drive half
    of it beyond the farthest of the training's `sensors`."""
    return max(max_distance, float(sensors.norm(dim=1).max()) + 0.5 * max_distance)


@torch.no_grad()
def bound_positions(part: Part, reach: float) -> None:
    """Moves Gaussians farther than `reach` metres from the origin of their part's frame onto the sphere of that radius,
    in place and without synchronising with the device. NaN and Inf stay as they are."""
    means = part.params["means"]
    distances = means.norm(dim=1, keepdim=True)
    outside = (distances > reach) & distances.isfinite()
    means.mul_(torch.where(outside, INSIDE * reach / distances, 1.0))
