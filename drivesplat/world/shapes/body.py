"""Bodies: rigid ones, and those whose limbs move."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from drivesplat.world.shapes.mesh import ColoredMesh


@runtime_checkable
class Body(Protocol):
    """The rigid pieces of an object and their motion in the object's frame (metres, x forward, y left, z up, the ground
    at z = 0)."""

    @property
    def pieces(self) -> tuple[ColoredMesh, ...]:
        """The pieces, each in its own frame."""

    @property
    def size(self) -> np.ndarray:
        """Length, width and height (3,) of the annotated box, whose floor is centred at the origin."""

    def poses(self, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """Piece to object (n, pieces, 4, 4) after `distance` (n,) metres travelled, at `seconds` (n,)."""


@dataclass(frozen=True)
class RigidBody:
    """A body of one piece."""

    mesh: ColoredMesh

    @property
    def pieces(self) -> tuple[ColoredMesh, ...]:
        return (self.mesh,)

    @cached_property
    def size(self) -> np.ndarray:
        return self.mesh.size

    def poses(self, distance: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.eye(4), (len(seconds), 1, 4, 4))
