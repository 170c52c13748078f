"""The content of actors.npz: the motion and the seed points of every object that becomes an actor.

The stage `actors` writes it (`drivesplat.preprocess.actor_seed`).
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from drivesplat.io.array_file import read_arrays, write_arrays
from drivesplat.io.storage import Provenance, unreadable
from drivesplat.io.typed_record import typed_record
from drivesplat.scene.motion import Motion

RULE = "actors"


@dataclass(frozen=True)
class ActorRecord:
    """An actor with p seed points: `id` and `category` as annotated, `size` (length, width, height in metres), `motion`
    in seconds since the scene's first image, `points` in the object's frame (metres) and their colours.

    The first `lidar_points` points are LiDAR returns. `pixels` is the number of pixels that show the actor, over all
    training images at training size. `part` names the part of a model that represents the actor.
    """

    id: str
    category: str
    size: Float[np.ndarray, "3"]
    motion: Motion
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    lidar_points: int
    pixels: int
    part: str = "actors"

    def to_plain(self) -> dict[str, Any]:
        """The record as plain containers and arrays."""
        return {**vars(self), "motion": self.motion.to_plain()}

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> "ActorRecord":
        """The inverse of `to_plain`. Raises AttributeError, KeyError, TypeError or ValueError if that fails."""
        return typed_record(cls, {**plain, "motion": Motion.from_plain(plain["motion"])})


@dataclass(frozen=True)
class ActorRecords:
    """The content of actors.npz; `actors` in order of id."""

    actors: list[ActorRecord]
    provenance: Provenance = field(default_factory=dict)


def write_actors(path: str | Path, record: ActorRecords) -> None:
    """Writes actors.npz."""
    write_arrays(path, {**vars(record), "actors": [actor.to_plain() for actor in record.actors]})


def read_actors(path: str | Path) -> ActorRecords:
    """Reads actors.npz. Raises ResultError that names the file and its rule if it is invalid."""
    content = read_arrays(path, RULE)
    try:
        actors = [ActorRecord.from_plain(actor) for actor in content["actors"]]
        return typed_record(ActorRecords, {**content, "actors": actors})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of actors ({error})") from error
