"""Floaters before the cameras: the recording car drove where they are, so nothing is there."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.model.part import Part

LARGEST_STEP = 15.0
"""Camera positions farther apart than this (metres) are not joined into a path."""


def camera_path(centers: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Starts and ends of the segments between consecutive camera positions, in time order.

    A lone position is a segment of no length.
    """
    starts, ends = centers[:-1], centers[1:]
    joined = (ends - starts).norm(dim=1) < LARGEST_STEP
    return torch.cat([starts[joined], centers]), torch.cat([ends[joined], centers])


def near_path(
    points: Float[Tensor, "n 3"], starts: Float[Tensor, "m 3"], ends: Float[Tensor, "m 3"], radius: float
) -> Bool[Tensor, " n"]:
    """Which points are nearer than `radius` metres to any of the segments."""
    near = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        fraction = ((points - start) @ along / along.dot(along).clamp(min=1e-12)).clamp(0.0, 1.0)
        near |= (points - start - fraction[:, None] * along).square().sum(dim=1) < radius**2
    return near


@torch.no_grad()
def fade_floaters(part: Part, starts: Float[Tensor, "m 3"], ends: Float[Tensor, "m 3"], radius: float) -> None:
    """Fades the Gaussians of a part that stands still within `radius` metres of the camera path."""
    part.fade(near_path(part.params["means"], starts, ends, radius))
