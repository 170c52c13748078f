"""The distance from the world's origin within which Gaussians lie; what is farther away is the sky's."""

from collections.abc import Sequence

import torch

from drivesplat.model.part import Part
from drivesplat.model.view import View

INSIDE = 1.0 - 1e-5
"""The share of the distance up to which positions are moved, so that they stay within it despite rounding."""


def reach_of(views: Sequence[View], max_distance: float) -> float:
    """The distance (metres) from the world's origin within which Gaussians lie: `max_distance`, or on a long drive half
    of it beyond the farthest camera."""
    cameras = [float(view.camera_to_world[:3, 3].norm()) for view in views]
    return max([max_distance, *(distance + 0.5 * max_distance for distance in cameras)])


@torch.no_grad()
def bound_positions(part: Part, reach: float) -> None:
    """Moves Gaussians farther than `reach` metres from the origin of their part's frame onto the sphere of that radius,
    in place and without synchronising with the device. NaN and Inf stay as they are."""
    means = part.params["means"]
    distances = means.norm(dim=1, keepdim=True)
    outside = (distances > reach) & distances.isfinite()
    means.mul_(torch.where(outside, INSIDE * reach / distances, 1.0))
