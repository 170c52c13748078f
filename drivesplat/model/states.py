"""What a sample of a model's Gaussians holds, and the tensors of a time that it depends on beside parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from drivesplat.model.actor_placements import ActorPlacement
from drivesplat.model.view import View


@dataclass(frozen=True)
class Want:
    """What a sample of Gaussians shall hold beside geometry and opacity: spherical harmonics of `colors`; `velocities`,
    which rolling shutters and LiDARs need; with `lidar` the Gaussians where a LiDAR sees them, and their
    `lidar_logits`. With `placements`, objects are at these and no others (None: as recorded)."""

    colors: bool = True
    velocities: bool = False
    lidar: bool = False
    placements: tuple[ActorPlacement, ...] | None = None


IMAGE = Want()
"""What an image with a global shutter shows."""
SCAN = Want(colors=False, velocities=True, lidar=True)
"""What a LiDAR measures."""


class State(NamedTuple):
    """What the Gaussians of a part depend on at a time, as tensors of the same shapes at every time: `now`, and
    HALF_STEP seconds `before` and `after`, which give velocities (None: they are not wanted, or need no states)."""

    now: Sequence[Tensor] = ()
    before: Sequence[Tensor] | None = None
    after: Sequence[Tensor] | None = None


ModelStates = tuple[State, ...]
"""The state of each part of a model."""


def want_of(view: View) -> Want:
    """What an image of a view shows: a rolling shutter also depends on velocities."""
    return IMAGE if view.shutter is None else Want(velocities=True)


def tensors_of(states: ModelStates) -> list[Tensor]:
    """All tensors of states, in a fixed order."""
    return [values for state in states for known in state if known is not None for values in known]


def copied(states: ModelStates) -> ModelStates:
    """A copy of states in memory of its own."""
    return tuple(State(*(None if known is None else [v.clone() for v in known] for known in state)) for state in states)
