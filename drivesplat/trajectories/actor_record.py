"""The content of actors.npz: the motion and the seed points of every object that becomes an actor.

The stage `actors` writes it (`drivesplat.preprocess.actor_seed`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance, no_provenance
from drivesplat.trajectories.motion import Motion

RULE = "actors"


@dataclass(frozen=True)
class ActorRecord:
    """An actor with p seed points: `id` and `category` as annotated, `size` (length, width, height in metres), `motion`
    in seconds since the scene's first image, `points` in the object's frame (metres) and their colours.

    The first `lidar_points` points are LiDAR returns. `pixels` is the number of pixels that show the actor, over all
    training images at training size. `parts` names the parts of a model that can represent the actor, the best first;
    `object_class` is an `ObjectClass`.
    """

    id: str
    category: str
    size: Float[np.ndarray, "3"]
    motion: Motion
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    lidar_points: int
    pixels: int
    parts: tuple[str, ...] = ("actors",)
    object_class: str = "vehicle"

    def fault(self) -> str | None:
        """What no record of `actors` holds, None without a fault."""
        if not (self.size > 0.0).all():
            return f"size of actor {self.id} is not positive"
        return None if 0 <= self.lidar_points <= len(self.points) else f"actor {self.id} has fewer points than returns"

    def part_in(self, parts: Sequence[str]) -> str | None:
        """The one of a model's `parts` that represents the actor; None: the background shows it."""
        return next((part for part in self.parts if part in parts), None)


@dataclass(frozen=True)
class ActorRecords:
    """The content of actors.npz; `actors` in order of id."""

    actors: list[ActorRecord]
    provenance: Provenance = field(default_factory=no_provenance)


def read_actors(path: str | Path) -> ActorRecords:
    """Reads actors.npz. Raises ResultError that names the file and its rule if it is invalid."""
    return read_typed_arrays(path, RULE, ActorRecords, "actors")
