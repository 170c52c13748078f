"""What a sample of a model's Gaussians holds, and what it depends on beside parameters: the places of objects, and the
tensors of a time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from torch import Tensor

from drivesplat.model.view import View
from drivesplat.scene.light import Shade


@dataclass(frozen=True)
class ActorPlacement:
    """An edited pose of an object at one time: the Gaussians of the track `source`, scaled by `scale` about the box
    centre, at `object_to_world` (4, 4) in world metres (None: the recorded pose), their RGB colours mapped by
    `color_matrix` (3, 3) (None: as trained). `around` are the poses HALF_STEP seconds before and after an edited one,
    which give velocities; None: the object stands. `walked` is the length (metres) of the object's path until then,
    which the limbs of deformable objects follow, and `walked_around` HALF_STEP seconds before and after; None: as
    recorded at the time. Their gait is ahead by `phase` cycles. With a `shade`, the object darkens the ground."""

    source: str
    object_to_world: np.ndarray | None = None
    scale: float = 1.0
    color_matrix: np.ndarray | None = None
    around: tuple[np.ndarray, np.ndarray] | None = None
    walked: float | None = None
    walked_around: tuple[float, float] | None = None
    phase: float = 0.0
    shade: Shade | None = None

    def beside(self, number: int) -> "ActorPlacement":
        """The placement HALF_STEP seconds before (0) or after (1)."""
        pose = self.object_to_world if self.around is None else self.around[number]
        walked = self.walked if self.walked_around is None else self.walked_around[number]
        return replace(self, object_to_world=pose, walked=walked)


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
    HALF_STEP seconds `before` and `after`, which give velocities (None: they are not wanted, or need no states). At
    each of these times the objects are `placed` (None: they are as recorded)."""

    now: Sequence[Tensor] = ()
    before: Sequence[Tensor] | None = None
    after: Sequence[Tensor] | None = None
    placed: Sequence[Tensor] | None = None


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
