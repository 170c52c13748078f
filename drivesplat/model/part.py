"""The components of a model: parts, which consist of Gaussians, and the sky behind them.

Each part owns its parameters, their learning rates and its densification. A method is a list of parts.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.handover import Handover
from drivesplat.model.states import IMAGE, ActorPlacement, State, Want
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.trajectories.motion import Motion

GEOMETRY = ("means", "quats", "scales", "opacities")
"""The parameters of every Gaussian that images and LiDAR scans share."""


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
    preallocated = 0
    """The number of rows at the end that are not Gaussians yet; 0 outside training. See `preallocate`."""
    count_on_device: Float[Tensor, ""]
    """The number of its Gaussians in device memory; valid only with `preallocated` rows."""

    def __init__(self) -> None:
        super().__init__()
        self.shared = nn.ParameterDict()
        self.register_buffer("count_on_device", torch.zeros(()), persistent=False)
        self.register_buffer("mirrored", None, persistent=False)

    def precompute(self, times: Sequence[float], want: Want = IMAGE) -> None:
        """Precomputes the states of times, which may be faster for many times together than one by one."""

    def state(self, time: float, want: Want = IMAGE) -> State:
        """What its Gaussians depend on at a time in seconds since the first image, beside parameters, as tensors on its
        device. A part without anything of that kind, as a static one, does not override this."""
        return State()

    @abstractmethod
    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        """Its Gaussians in world coordinates, with what is wanted. Velocities have no gradient; they are None for a
        static part, as `lidar_logits` are for one that was not trained with LiDAR.

        Always `self.row_count` rows in one order; a Gaussian that is absent at the time has opacity 0. With placements,
        an object without one is absent, and further placements of one object are appended as extra rows. Otherwise the
        sample depends on the state's tensors and on parameters alone and does not synchronise with the device, so that
        a CUDA graph of it can be replayed after the state of another time is copied into these tensors.
        """

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every entry of `params` and `shared` that is learned."""

    def definition(self) -> PartDefinition:
        """What the checkpoint needs beside parameters and settings."""
        return PartDefinition(self.name, self.extent)

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        """Its Gaussians with the colours of a time as rigid groups: one static group, or one for every track. Names are
        unique in a model."""
        return {self.name: RigidGroup(self.sample(self.state(time)), None)}

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
        """Fades Gaussians at places where this part must not have any; may move others back to where they belong."""

    def take_over(self, other: "Part", handover: Handover) -> None:
        """Starts, before a training, from what a part of this kind has learned in the block before. A part that can
        start from nothing else than its seed, as this one, does nothing."""

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


def preallocate(part: Part, rows: int) -> None:
    """Declares so many rows at the end of a part preallocated (`drivesplat.training.graphs.preallocation`)."""
    part.preallocated = rows
    part.count_on_device.fill_(part.row_count - rows)


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
