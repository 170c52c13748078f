"""Taking a vehicle out of a trained model: by its own Gaussians where the model knows them, else by its box."""

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
    """`removed` (n,) bool rows of the model's Gaussians; `by`: what told them from the rest."""

    removed: Bool[Tensor, " n"]
    by: Literal["actor", "box"]


def removal_of(model: SplatModel, gaussians: Gaussians, box: Box, margin: float) -> Removal:
    """What is to be removed of `gaussians` (the model's at the time of `box`) so that the box's object goes.

    A model that knows the object gives its Gaussians; of any other, those go whose centres lie in the box, grown
    by `margin` metres at its sides and roof.
    """
    own = model.of_track(box.track_id)
    if own is not None:
        return Removal(own, "actor")
    inside = box.holds(gaussians.means.detach().cpu().double().numpy(), margin)
    return Removal(torch.from_numpy(inside).to(gaussians.means.device), "box")
