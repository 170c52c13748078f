"""Dropout of Gaussians: each iteration with an image leaves some of them out at random."""

from dataclasses import replace

import torch

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel


def with_dropout(gaussians: Gaussians, model: SplatModel, share: float) -> Gaussians:
    """The Gaussians of a model with a random `share` of those of its static parts left out: their opacity is 0.

    As DropGaussian (Park et al., CVPR 2025), but with a constant share and without raising the opacity of the others.
    Loss terms that ignore Gaussians of opacity 0 (opacity, scale, road) ignore these, too, and pictures of the training
    lack them. Uses torch's global random generator. No host synchronisation.
    """
    kept = torch.rand_like(gaussians.opacities) >= share
    for part, rows in zip(model.parts, model.rows, strict=True):
        if part.moves:
            kept[rows] = True
    return replace(gaussians, opacities=gaussians.opacities * kept)
