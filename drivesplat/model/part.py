"""The components of a model: parts, which consist of Gaussians, and the sky behind them.

Each part owns its parameters, their learning rates and its densification. A method is a list of parts.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from drivesplat.model.gaussians import Gaussians, without_colors
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.trajectories.motion import HALF_STEP, Motion

GEOMETRY = ("means", "quats", "scales", "opacities")
"""The parameters of every Gaussian that images and LiDAR scans share."""
FADED = 1e-4
"""Opacity of a faded Gaussian, below the threshold at which every strategy removes or relocates it."""


@dataclass(frozen=True)
class ActorPlacement:
    """An edited pose of an object at one time: the Gaussians of the track `source`, scaled by `scale` about the box
    centre, at `object_to_world` (4, 4) in world metres (None: the recorded pose), their RGB colours mapped by
    `color_matrix` (3, 3) (None: as trained). `around` are the poses HALF_STEP seconds before and after an edited one,
    which give velocities; None: the object stands. `walked` is the length (metres) of the object's path until then,
    which the limbs of deformable objects follow, and `walked_around` HALF_STEP seconds before and after; None: as
    recorded at the time. Their gait is ahead by `phase` cycles."""

    source: str
    object_to_world: np.ndarray | None = None
    scale: float = 1.0
    color_matrix: np.ndarray | None = None
    around: tuple[np.ndarray, np.ndarray] | None = None
    walked: float | None = None
    walked_around: tuple[float, float] | None = None
    phase: float = 0.0

    def beside(self, number: int) -> "ActorPlacement":
        """The placement HALF_STEP seconds before (0) or after (1)."""
        pose = self.object_to_world if self.around is None else self.around[number]
        walked = self.walked if self.walked_around is None else self.walked_around[number]
        return replace(self, object_to_world=pose, walked=walked)


@dataclass(frozen=True)
class PartDefinition:
    """What a checkpoint needs of the part named `part` beside parameters and settings: its extent in metres, the tracks
    that own its Gaussians, and the times of the first and the last training image, where they matter."""

    part: str
    extent: float
    tracks: tuple[ActorTrack, ...] = ()
    seconds: tuple[float, float] | None = None


@dataclass(frozen=True)
class RigidGroup:
    """Gaussians that move as one rigid body: in world coordinates where `motion` is None, else in the frame of the
    moving object (their spherical harmonics too). Those of an object that deforms have the shape of one time."""

    gaussians: Gaussians
    motion: Motion | None


class Shapes(NamedTuple):
    """The centres (metres) and unit quaternions (w, x, y, z) of an object's n Gaussians in its frame at t times."""

    means: Float[Tensor, "t n 3"]
    quats: Float[Tensor, "t n 4"]


class Part(nn.Module, ABC):
    """A set of Gaussians: the static background, the moving actors, ...

    `params` holds the parameters of each Gaussian, a row each, under gsplat's names (`drivesplat.model.parameters`), as
    gsplat's strategies expect them; `shared` those that several Gaussians share.
    """

    name: str
    moves = False
    """Whether its Gaussians are dynamic: at other places at other times."""
    has_objects = False
    """Whether its Gaussians belong to objects with tracks."""
    mirrored: Float[Tensor, " a"] | None
    """The probabilities with which an iteration of a training mirrors each of its a objects; None: never."""
    geometry: tuple[str, ...] = GEOMETRY
    """Those of `params` that both images and LiDAR scans fit."""
    decaying: tuple[str, ...] = ("means",)
    """Those of `params` and `shared` whose learning rates decay in a training: positions, and what they follow from."""
    extent: float
    """Extent of its Gaussians in metres, which scales densification and the learning rate of positions."""
    cap_max: int | None = None
    """Maximum number of Gaussians in densification; None: that of the training's settings."""
    params: nn.ParameterDict
    count_on_device: Float[Tensor, ""]
    """The number of its Gaussians in device memory; valid only with `preallocated` rows."""

    def __init__(self) -> None:
        super().__init__()
        self.shared = nn.ParameterDict()
        self._preallocated = 0
        self.register_buffer("count_on_device", torch.zeros(()), persistent=False)
        self.register_buffer("mirrored", None, persistent=False)

    def precompute(self, times: Sequence[float]) -> None:
        """Precomputes state for the given times, which may be faster for many times together than one by one."""

    def at(self, time: float) -> Gaussians:
        """Its Gaussians in world coordinates at a time in seconds since the first image.

        Always `self.row_count` rows in one order; a Gaussian that is absent then has opacity 0. A part without time
        states overrides this.
        """
        return self.at_time_state(self.time_state(time))

    def time_state(self, time: float) -> Sequence[Tensor] | None:
        """The state of its Gaussians at a time as tensors on its device, of the same shapes at every time:
        `at_time_state` of it equals `at`. None for a part without such a state."""
        return None

    def at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        """Its Gaussians by a `time_state`. Depends on these tensors alone and does not synchronise with the device, so
        that a CUDA graph of it can be replayed after the tensors of another time are copied into them. Raises
        NotImplementedError for a part without time states."""
        raise NotImplementedError(f"the part {self.name!r} has no time states")

    def velocities(self, time: float) -> Float[Tensor, "n 3"] | None:
        """The velocities of its Gaussians in the world at a time, m/s, without gradient; None for a static part."""
        states = self._beside(time)
        return None if any(state is None for state in states) else self.velocities_between(*states)

    def _beside(self, time: float) -> tuple[Sequence[Tensor] | None, Sequence[Tensor] | None]:
        """The time states HALF_STEP seconds before and after a time."""
        return self.time_state(time - HALF_STEP), self.time_state(time + HALF_STEP)

    def velocities_between(self, before: Sequence[Tensor], after: Sequence[Tensor]) -> Float[Tensor, "n 3"] | None:
        """As `velocities`, by the time states HALF_STEP seconds before and after the time. Depends on these tensors
        alone, as `at_time_state`."""
        return None

    def echoes(self, time: float) -> Float[Tensor, "n 4 2"] | None:
        """What a LiDAR measures of its Gaussians at a time, along directions in the world (`Gaussians.echoes`); None
        for a part that was not trained with LiDAR."""
        state = self.time_state(time)
        return None if state is None else self.echoes_at_time_state(state)

    def echoes_at_time_state(self, time_state: Sequence[Tensor]) -> Float[Tensor, "n 4 2"] | None:
        """As `echoes`, by a `time_state`. Depends on these tensors alone, as `at_time_state`."""
        return None

    def seen_by_lidar(self, gaussians: Gaussians) -> Gaussians:
        """Its Gaussians where a LiDAR sees them, by those that cameras see (`at`)."""
        return gaussians

    def scanned_at_time_state(self, time_state: Sequence[Tensor]) -> Gaussians:
        """Its Gaussians where a LiDAR sees them, with echoes but without colours, by a `time_state`. Depends on these
        tensors alone, as `at_time_state`."""
        seen, echoes = self.seen_by_lidar(self.at_time_state(time_state)), self.echoes_at_time_state(time_state)
        return without_colors(seen.means, seen.quats, seen.scales, seen.opacities, echoes)

    def with_placements(self, time: float, placements: Sequence[ActorPlacement]) -> Gaussians:
        """As `at`, with objects at `placements`: an object without a placement is absent; further placements of one
        object are appended as extra rows."""
        return self.at(time)

    def velocities_with_placements(
        self, time: float, placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "m 3"] | None:
        """The `velocities` of all rows of `with_placements`."""
        return self.velocities(time)

    def echoes_with_placements(
        self, time: float, placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "m 4 2"] | None:
        """The `echoes` of all rows of `with_placements`."""
        return self.echoes(time)

    def placement_of_rows(self, placements: Sequence[ActorPlacement]) -> Int[Tensor, " m"]:
        """The index of the placement that each row of `with_placements` belongs to; -1 for none."""
        return torch.full((self.row_count,), -1, device=self.params["means"].device)

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every entry of `params` and `shared` that is learned."""

    def definition(self) -> PartDefinition:
        """What the checkpoint needs beside parameters and settings."""
        return PartDefinition(self.name, self.extent)

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        """Its Gaussians with the colours of a time as rigid groups: one static group, or one for every track. Names are
        unique in a model."""
        return {self.name: RigidGroup(self.at(time), None)}

    def shapes(self, track_id: str, times: Sequence[float]) -> Shapes | None:
        """The shapes of a track's Gaussians at `times`, in the order of its rigid group; None for what is rigid."""
        return None

    def shape_weights(
        self, times: Sequence[float], placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "t k"] | None:
        """The k values in which the shape of a track is linear, or nearly so, at `times`, each with its placement of
        that track; the first is 1. None for what is rigid."""
        return None

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """Its own weighted terms of the training loss, by name."""
        return {}

    def confine(self) -> None:
        """Fades Gaussians at places where this part must not have any."""

    @torch.no_grad()
    def fade(self, rows: Bool[Tensor, " n"]) -> None:
        """Makes Gaussians nearly transparent."""
        opacities, faded = self.params["opacities"], torch.logit(torch.tensor(FADED)).item()
        opacities.masked_fill_(rows & (opacities > faded), faded)

    def of_track(self, track_id: str) -> Bool[Tensor, " n"] | None:
        """The mask of a track's rows; None where this part does not know the track as an object."""
        return None

    def broken_tracks(self) -> list[str]:
        """The ids of tracks with parameters that are not finite."""
        return []

    def __len__(self) -> int:
        """The number of its Gaussians."""
        return self.row_count - self.preallocated

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics of its colours: `params["shN"]` (n, ..., k - 1, 3) has k = (degree +
        1)² coefficients with `sh0`."""
        return math.isqrt(1 + self.params["shN"].shape[-2]) - 1

    @property
    def row_count(self) -> int:
        """The number of rows of each of `params`."""
        return len(self.params["means"])

    @property
    def preallocated(self) -> int:
        """The number of rows at the end that are not Gaussians yet (`drivesplat.training.cuda_graph.preallocation`);
        0 outside training."""
        return self._preallocated

    @preallocated.setter
    def preallocated(self, rows: int) -> None:
        self._preallocated = rows
        self.count_on_device.fill_(self.row_count - rows)


def active_fraction(parts: Iterable[Part]) -> float | Float[Tensor, ""]:
    """The fraction of the parts' rows that are Gaussians. With preallocated rows it is a tensor computed from
    `count_on_device`, so that a replayed CUDA graph sees the current number."""
    every = list(parts)
    if not any(part.preallocated for part in every):
        return 1.0
    active = sum(part.count_on_device if part.preallocated else len(part) for part in every)
    return active / sum(part.row_count for part in every)


class Sky(nn.Module, ABC):
    """The background colour by direction, seen where no Gaussian is."""

    params: nn.ParameterDict
    keeps_gaussians_out: bool
    """Whether the loss keeps Gaussians out of sky pixels, so that only the sky is seen there."""

    @abstractmethod
    def colors(self, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """RGB in [0, 1] seen along unit world directions."""

    def behind(
        self,
        splats: Float[Tensor, "h w 3"],
        alpha: Float[Tensor, "h w 1"],
        view: View,
    ) -> Float[Tensor, "h w 3"]:
        """Composites `splats`, premultiplied by `alpha`, over this sky."""
        return splats + (1.0 - alpha) * self.colors(view.rays())

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """The learning rate of every entry of `params`."""
