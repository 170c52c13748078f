"""Deformations of Gaussians in the frames of their objects, and the fields that give them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class Deformation(NamedTuple):
    """What n Gaussians are moved by in the frames of their objects: `shifts` in metres, and `turns`, rotation vectors
    halved (radians): the rotation of a turn t is the normalised quaternion (1, t)."""

    shifts: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 3"]

    @classmethod
    def of(cls, values: Float[Tensor, "n 6"]) -> "Deformation":
        return cls(values[:, :3], values[:, 3:])


@dataclass(frozen=True)
class Undeformed:
    """n Gaussians of a objects: their centres (metres, in the frames of their objects), the object of each as index and
    as one-hot matrix, and half the size (metres) of the objects' boxes, enlarged by the margin."""

    means: Float[Tensor, "n 3"]
    owner: Int[Tensor, " n"]
    owns: Float[Tensor, "n a"]
    reach: Float[Tensor, "a 3"]


class Field(ABC):
    """A function of the place in an object's box and of k functions of phase and time, with learned parameters."""

    @abstractmethod
    def initial(self, count: int) -> dict[str, Tensor]:
        """The parameters for `count` objects, which deform nothing."""

    @abstractmethod
    def deformation(
        self, parameters: Mapping[str, Tensor], gaussians: Undeformed, basis: Float[Tensor, "a k"]
    ) -> Deformation:
        """The deformation where the k functions of each object have the values `basis`."""

    @abstractmethod
    def penalties(self, parameters: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
        """Weighted terms of the training loss, by name."""

    @property
    @abstractmethod
    def learning_rate(self) -> float:
        """That of the parameters."""
