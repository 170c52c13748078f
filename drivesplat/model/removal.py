"""Removing a vehicle from a trained model: by its own Gaussians where the model knows them, else by its box."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.tracks import Box


@dataclass(frozen=True)
class Removal:
    """`removed` (n,) bool rows of the model's Gaussians; `by`: the criterion that selected them."""

    removed: Bool[Tensor, " n"]
    by: Literal["actor", "box"]


def removal_of(model: SplatModel, gaussians: Gaussians, box: Box, margin: float) -> Removal:
    """The rows of `gaussians`, the model's at the time of `box`, that show the object in the box.

    The object's own Gaussians where the model knows it, else those with centres in the box, enlarged by `margin` metres
    at its sides and roof.
    """
    own = model.of_track(box.track_id)
    if own is not None:
        return Removal(own, "actor")
    inside = box.contains(gaussians.means.detach().cpu().double().numpy(), margin)
    return Removal(torch.from_numpy(inside).to(gaussians.means.device), "box")
