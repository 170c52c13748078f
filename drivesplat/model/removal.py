"""Removing a vehicle from a trained model: by its own Gaussians where the model knows them, else by its box."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.tracks import Box

MOSTLY = 0.5
"""Share of an object's Gaussians in the box from which it is the object of the box."""


@dataclass(frozen=True)
class Removal:
    """`removed` (n,) bool rows of the model's Gaussians; `by`: the criterion that selected them."""

    removed: Bool[Tensor, " n"]
    by: Literal["actor", "box"]


def removal_of(model: SplatModel, gaussians: Gaussians, box: Box, margin: float) -> Removal:
    """The rows of `gaussians`, the model's at the time of `box`, that show the object in the box.

    The object's own Gaussians where the model knows it, by its track or as objects most of whose Gaussians lie in the
    box (discovered ones); else those with centres in the box, enlarged by `margin` metres at its sides and roof.
    """
    own = model.of_track(box.track_id)
    if own is not None:
        return Removal(own, "actor")
    means = gaussians.means.detach()
    reach = float(np.linalg.norm(box.size)) + 2.0 * margin + 1.0  # more than to any corner
    near = (means - means.new_tensor(box.object_to_world[:3, 3])).norm(dim=1) < reach
    inside = near.clone()
    inside[near] = torch.from_numpy(box.contains(means[near].cpu().double().numpy(), margin)).to(means.device)
    known = [name for part in model.parts if part.has_objects for name in part.rigid_groups(0.0)]
    objects = (model.of_track(name) for name in known)
    there = [rows for rows in objects if rows is not None and rows.any() and inside[rows].float().mean() > MOSTLY]
    return Removal(torch.stack(there).any(dim=0), "actor") if there else Removal(inside, "box")
