"""Mirrored people: iterations render people and animals as their mirror images at random, so that each side learns from
images of the other, as vehicles in AutoSplat (Khan et al. 2024, arXiv 2407.02598)."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, ModelStates, State, Want
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings
from drivesplat.settings.train_objects import DeformableSettings


def choose_mirrored(model: SplatModel, record: TrainingRecord, settings: TrainSettings) -> None:
    """Sets the probabilities `Part.mirrored` of all objects that deform, for the training images of a scene."""
    for part in model.parts:
        if isinstance(part, Deformable):
            shares = mirrored_shares(part.timeline.tracks, record, settings.deformable)
            part.mirrored = torch.from_numpy(shares).float().to(part.params["means"].device) if shares.any() else None


def mirrored_shares(
    tracks: Sequence[ActorTrack], record: TrainingRecord, settings: DeformableSettings
) -> Float[np.ndarray, " a"]:
    """The probability with which iterations mirror each object: `mirrored`, or less for one that is present in more
    than `mirrored_images` training images of each camera, in the mean."""
    times = np.array([record.seconds(i) for i in record.train_images])
    present = np.array([track.motion.present(times).sum() for track in tracks]) / max(1, len(record.train_cameras))
    return settings.mirrored * np.clip(2.0 - present / settings.mirrored_images, 0.0, 1.0)


def sets_with_mirrored_objects(model: SplatModel, states: ModelStates, want: Want = IMAGE) -> list[Gaussians]:
    """The set of Gaussians of each part, as `SplatModel.sample`, with objects mirrored at random by `Part.mirrored`.
    Uses torch's global random generator, where objects are mirrored. No host synchronisation.
    """
    shares = [part.mirrored for part in model.parts]
    return model.sample(tuple(map(_mirrored, states, shares)), want)


def _mirrored(state: State, shares: Float[Tensor, " a"] | None) -> State:
    """The state of a part with its objects mirrored, each with its probability; None for a part that mirrors none."""
    if shares is None:
        return state
    side = TimeState(*state.now).side
    side = torch.where(torch.rand_like(side) < shares, -side, side)
    return State(*(None if known is None else TimeState(*known)._replace(side=side) for known in state))
