"""Mirrored people: iterations render people and animals as their mirror images at random, so that each side learns from
images of the other, as vehicles in AutoSplat (Khan et al. 2024, arXiv 2407.02598)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.time_states import TimeStates
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.model.view import View
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings
from drivesplat.settings.train_objects import DeformableSettings
from drivesplat.trajectories.motion import HALF_STEP


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


def sets_with_mirrored_objects(model: SplatModel, view: View, states: TimeStates | None) -> list[Gaussians]:
    """The set of Gaussians of each part in a view, as `SplatModel.sets_in`, by the parts' time `states` (None: to be
    looked up), with objects mirrored at random by `Part.mirrored`. Uses torch's global random generator, where objects
    are mirrored. No host synchronisation.
    """
    if all(part.mirrored is None for part in model.parts):
        return model.sets_in(view) if states is None else model.sets_at_time_states(states)
    now = model.time_states(view.time) if states is None else states
    sides = [_random_sides(state, part.mirrored) for part, state in zip(model.parts, now, strict=True)]
    sets = model.sets_at_time_states(_on_sides(now, sides))
    if view.shutter is None or not model.rolling_shutter:
        return sets
    beside = (_on_sides(model.time_states(view.time + seconds), sides) for seconds in (-HALF_STEP, HALF_STEP))
    around = zip(sets, model.parts, *beside, strict=True)
    return [replace(own, velocities=part.velocities_between(before, after)) for own, part, before, after in around]


def _random_sides(state: Sequence[Tensor], shares: Float[Tensor, " a"] | None) -> Float[Tensor, " a"] | None:
    """The sides of a part's objects, each mirrored with its probability; None for a part that mirrors none."""
    if shares is None:
        return None
    side = TimeState(*state).side
    return torch.where(torch.rand_like(side) < shares, -side, side)


def _on_sides(states: TimeStates, sides: Sequence[Float[Tensor, " a"] | None]) -> TimeStates:
    return [
        state if side is None else TimeState(*state)._replace(side=side)
        for state, side in zip(states, sides, strict=True)
    ]
