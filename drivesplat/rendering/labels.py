"""What each pixel of a rendering belongs to, and depth and objects as 16-bit images."""

import numpy as np
import torch
from jaxtyping import Float, Int, Int16, UInt16
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.groups import strongest_group
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.readers.truth import DEPTH_LIMIT, DEPTH_UNITS_PER_METRE


def strongest_in_view(
    model: SplatModel, gaussians: Gaussians, groups: Int[Tensor, " n"], view: View
) -> Int16[Tensor, "h w"]:
    """The one of `groups`, numbers from -1 of n Gaussians, that contributes most to each pixel; -1 where the sky does,
    or nothing is met."""

    def composited(shares: Tensor) -> Tensor:
        return model.composited(gaussians, shares.to(gaussians.means), view).image.squeeze(0)

    sky = 1.0 - model.composited(gaussians, gaussians.means.new_ones(len(gaussians), 1), view).alpha
    return strongest_group(groups, composited, sky.squeeze((0, 3))).to(torch.int16)


def objects_in_view(model: SplatModel, gaussians: Gaussians, view: View) -> Int16[Tensor, "h w"]:
    """The index of the placement whose object a pixel shows, -1 where something else is shown, of Gaussians that were
    sampled with placements."""
    if gaussians.placement is None:
        return torch.full((view.height, view.width), -1, dtype=torch.int16, device=gaussians.means.device)
    return strongest_in_view(model, gaussians, gaussians.placement, view)


def depth_units(depth: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Depths in metres in units of 1/256 m, 0 where there is none, as images of depth contain them."""
    return np.clip(depth * DEPTH_UNITS_PER_METRE + 0.5, 0, DEPTH_LIMIT).astype(np.uint16)


def numbered(indices: Int16[np.ndarray, "h w"], numbers: list[int]) -> UInt16[np.ndarray, "h w"]:
    """The number of each index, 0 for -1, as images of objects contain them."""
    return np.array([*numbers, 0], dtype=np.uint16)[indices]  # the last is what -1 finds
