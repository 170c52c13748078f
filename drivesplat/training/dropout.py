"""Dropout of Gaussians: each iteration with an image leaves some of them out at random."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings


def dropout_share(record: TrainingRecord, settings: TrainSettings) -> float:
    """The share of the static Gaussians that iterations leave out: `dropout`, or less where the cameras have more than
    `dropout_images` training images each, in the mean."""
    images, cameras = len(record.train_images), len(record.train_cameras)
    return settings.dropout * min(1.0, settings.dropout_images * cameras / max(1, images))


def with_dropout(sets: Sequence[Gaussians], model: SplatModel, share: float) -> list[Gaussians]:
    """The sets of Gaussians of a model's parts, with a random `share` of static ones left out: their opacity is 0.

    As DropGaussian (Park et al., CVPR 2025), but with a constant share and without raising the opacity of the others.
    Loss terms that ignore Gaussians of opacity 0 (opacity, scale, road) ignore these, too. Uses torch's global random
    generator. No host synchronisation.
    """
    found = []
    for part, own in zip(model.parts, sets, strict=True):
        if not part.moves:
            kept = torch.rand_like(own.opacities) >= share
            own = replace(own, opacities=own.opacities * kept)
        found.append(own)
    return found
