"""Random changes of what a step renders, so that the model generalises: mirrored people and dropout of Gaussians. Both
use torch's global random generator and do not synchronise with the device."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ModelStates, State
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings
from drivesplat.settings.train_objects import DeformableSettings


def choose_mirrored(model: SplatModel, record: TrainingRecord, settings: TrainSettings) -> None:
    """Sets the probabilities `Part.mirrored` of all objects that deform, for the training images of a scene: each side
    of a person or animal learns from images of the other, as vehicles in AutoSplat (Khan et al. 2024, arXiv
    2407.02598)."""
    for part in model.parts:
        if isinstance(part, Deformable):
            shares = mirrored_shares(part.timeline.tracks, record, settings.deformable)
            part.mirrored = torch.from_numpy(shares).float().to(part.params["means"].device) if shares.any() else None


def mirrored_shares(
    tracks: Sequence[ActorTrack], record: TrainingRecord, settings: DeformableSettings
) -> Float[np.ndarray, " a"]:
    """The probability with which steps mirror each object: `mirrored`, or less for one that is present in more than
    `mirrored_images` training images of each camera, in the mean."""
    times = np.array([record.seconds(i) for i in record.train_images])
    present = np.array([track.motion.present(times).sum() for track in tracks]) / max(1, len(record.train_cameras))
    return settings.mirrored * np.clip(2.0 - present / settings.mirrored_images, 0.0, 1.0)


def mirrored_at_random(model: SplatModel, states: ModelStates) -> ModelStates:
    """The states of a model's parts with objects mirrored at random by `Part.mirrored`; no random number is drawn for a
    part that mirrors none."""
    return tuple(
        state if part.mirrored is None else _mirrored_at_random(state, part.mirrored)
        for part, state in zip(model.parts, states, strict=True)
    )


def _mirrored_at_random(state: State, shares: Float[Tensor, " a"]) -> State:
    side = TimeState(*state.now).side
    side = torch.where(torch.rand_like(side) < shares, -side, side)
    return State(*(None if at is None else TimeState(*at)._replace(side=side) for at in state))


def dropout_share(record: TrainingRecord, settings: TrainSettings) -> float:
    """The share of the static Gaussians that steps leave out: `dropout`, or less where the cameras have more than
    `dropout_images` training images each, in the mean."""
    images, cameras = len(record.train_images), len(record.train_cameras)
    return settings.dropout * min(1.0, settings.dropout_images * cameras / max(1, images))


def with_dropout(sets: Sequence[Gaussians], model: SplatModel, share: float) -> list[Gaussians]:
    """The sets of Gaussians of a model's parts, with a random `share` of static ones left out: their opacity is 0.

    As DropGaussian (Park et al., CVPR 2025), but with a constant share and without raising the opacity of the others.
    Loss terms that ignore Gaussians of opacity 0 (opacity, scale, road) ignore these, too.
    """
    found = []
    for part, own in zip(model.parts, sets, strict=True):
        if not part.moves:
            kept = torch.rand_like(own.opacities) >= share
            own = replace(own, opacities=own.opacities * kept)
        found.append(own)
    return found
