"""What a method is made of: parts that place Gaussians, and a sky behind them.

Each part owns its parameters, their learning rates and its densification. A method is a list of parts.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor, nn

from drivesplat.model.gaussians import Gaussians
from drivesplat.motion import Motion


@dataclass(frozen=True)
class Piece:
    """Gaussians that move as one: in world coordinates where `motion` is None, else in the frame of the object that
    moves so (spherical harmonics, too)."""

    gaussians: Gaussians
    motion: Motion | None


class Part(nn.Module, ABC):
    """A set of Gaussians: the world's static background, a moving actor, ...

    `params` holds what is optimised, under gsplat's names where a gsplat strategy densifies it.
    """

    name: str
    moves = False
    """Whether its Gaussians are objects that are elsewhere at another time."""
    params: nn.ParameterDict

    @abstractmethod
    def at(self, time: float) -> Gaussians:
        """Its Gaussians in world coordinates at a time in seconds since the first image.

        Always `len(self)` rows in one order; one that is absent then has opacity 0.
        """

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every entry of `params`."""

    def pieces(self, time: float) -> dict[str, Piece]:
        """What it consists of, by names unique in a model, with the colours of a time: a set that stands still, or one
        for every track."""
        return {self.name: Piece(self.at(time), None)}

    def of_track(self, track_id: str) -> Bool[Tensor, " n"] | None:
        """Which of its rows are a track's own; None where this part does not know the track as an object."""
        return None

    def __len__(self) -> int:
        return len(self.params["means"])


class Sky(nn.Module, ABC):
    """What is seen where no Gaussian is: a colour by direction."""

    params: nn.ParameterDict
    keeps_gaussians_out: bool
    """Whether Gaussians are to stay out of sky pixels, since this sky alone is to be seen there."""

    @abstractmethod
    def colors(self, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """RGB in [0, 1] seen along unit world directions."""

    @abstractmethod
    def learning_rates(self) -> dict[str, float]:
        """The learning rate of every entry of `params`."""
