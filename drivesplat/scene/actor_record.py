"""The objects that become actors, as actors.npz holds them: how they move and where their Gaussians start.

The stage `actors` makes it (`drivesplat.preprocess.actor_seed`).
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
    """An actor of p seed points: `id` and `category` as annotated, `size` (length, width, height in metres), `motion`
    in seconds since the scene's first image, `points` in the object's frame (metres) with their colours.

    The first `lidar_points` of the points are LiDAR returns; `pixels` of training images, at the size of training,
    show the actor.
    """

    id: str
    category: str
    size: Float[np.ndarray, "3"]
    motion: Motion
    points: Float[np.ndarray, "p 3"]
    points_rgb: UInt8[np.ndarray, "p 3"]
    lidar_points: int
    pixels: int

    def to_plain(self) -> dict[str, Any]:
        """As plain data and arrays."""
        return {**vars(self), "motion": self.motion.to_plain()}

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> "ActorRecord":
        """The inverse of `to_plain`. Raises AttributeError, KeyError, TypeError or ValueError where `plain` is none."""
        return typed_record(cls, {**plain, "motion": Motion.from_plain(plain["motion"])})


@dataclass(frozen=True)
class ActorRecords:
    """The content of actors.npz; `actors` by id."""

    actors: list[ActorRecord]
    provenance: Provenance = field(default_factory=dict)


def write_actors(path: str | Path, record: ActorRecords) -> None:
    """Writes actors.npz."""
    write_arrays(path, {**vars(record), "actors": [actor.to_plain() for actor in record.actors]})


def read_actors(path: str | Path) -> ActorRecords:
    """Reads actors.npz. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_arrays(path, RULE)
    try:
        actors = [ActorRecord.from_plain(actor) for actor in content["actors"]]
        return typed_record(ActorRecords, {**content, "actors": actors})
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of actors ({error})") from error
