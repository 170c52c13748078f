"""The Gaussians that an iteration with an image renders, some changed at random."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.time_states import TimeStates
from drivesplat.model.timeline import TimeState
from drivesplat.model.view import View
from drivesplat.scene.motion import HALF_STEP
from drivesplat.training.dropout import with_dropout


def sets_of_iteration(model: SplatModel, view: View, states: TimeStates | None, dropout: float) -> list[Gaussians]:
    """The sets of Gaussians of a model's parts that an iteration with a view renders, by the parts' time `states`
    (None: to be looked up). Objects are mirrored at random, with the probability `Part.mirrored` of their part, and a
    share `dropout` of the static Gaussians is left out. Uses torch's global random generator. No host synchronisation.

    Mirroring is that of AutoSplat (Khan et al. 2024, arXiv 2407.02598), which mirrors vehicles.
    """
    if any(part.mirrored for part in model.parts):
        sets = _with_mirrored_objects(model, view, states)
    else:
        sets = model.sets_in(view) if states is None else model.sets_at_time_states(states)
    return with_dropout(sets, model, dropout) if dropout else sets


def _with_mirrored_objects(model: SplatModel, view: View, states: TimeStates | None) -> list[Gaussians]:
    now = model.time_states(view.time) if states is None else states
    sides = [_random_sides(state, part.mirrored) for part, state in zip(model.parts, now, strict=True)]
    sets = model.sets_at_time_states(_on_sides(now, sides))
    if view.shutter is None or not model.rolling_shutter:
        return sets
    beside = (_on_sides(model.time_states(view.time + seconds), sides) for seconds in (-HALF_STEP, HALF_STEP))
    around = zip(sets, model.parts, *beside, strict=True)
    return [replace(own, velocities=part.velocities_between(before, after)) for own, part, before, after in around]


def _random_sides(state: Sequence[Tensor], share: float) -> Float[Tensor, " a"] | None:
    """The sides of a part's objects, a random `share` of them mirrored; None without any."""
    if not share:
        return None
    side = TimeState(*state).side
    return torch.where(torch.rand_like(side) < share, -side, side)


def _on_sides(states: TimeStates, sides: Sequence[Float[Tensor, " a"] | None]) -> TimeStates:
    return [
        state if side is None else TimeState(*state)._replace(side=side)
        for state, side in zip(states, sides, strict=True)
    ]
