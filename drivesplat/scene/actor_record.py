"""What actors.pkl holds: the vehicles that move, how they move, and where their Gaussians start.

    actors           by id; of each
        id, category     as annotated
        size             (3,) float64: length, width, height in metres
        times            (k,) float64: seconds since the scene's first image
        object_to_world  (k, 4, 4) float64 at `times`
        runs, reach      the further fields of `drivesplat.scene.motion.Motion`; runs as [first, last]
        points           (p, 3) float32 in the object's frame, metres
        points_rgb       (p, 3) uint8
        lidar_points     how many of the points are LiDAR's: the first so many
        pixels           how many pixels of training images, at the size of training, are its own
    provenance

The stage `actors` makes it (`drivesplat.preprocess.actor_seed`).
"""

from pathlib import Path
from typing import Any

from drivesplat.io.plain_pickle import read_plain_pickle
from drivesplat.io.storage import unreadable
from drivesplat.scene.motion import Motion

_KEYS = {
    "id", "category", "size", "times", "object_to_world", "runs", "reach",
    "points", "points_rgb", "lidar_points", "pixels",
}  # fmt: skip


def read_actors(path: str | Path) -> dict[str, Any]:
    """Reads actors.pkl. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_plain_pickle(path, rule="actors")
    try:
        if not content.keys() >= {"actors", "provenance"}:
            raise ValueError("it lacks the keys of one")
        if any(not actor.keys() >= _KEYS for actor in content["actors"]):
            raise ValueError("an actor in it lacks keys")
    except (AttributeError, TypeError, ValueError) as error:
        raise unreadable(path, "actors", f"not a record of actors ({error})") from error
    return content


def motion_of(actor: dict[str, Any]) -> Motion:
    """The motion of an actor of the record."""
    runs = tuple((first, last) for first, last in actor["runs"])
    return Motion(actor["times"], actor["object_to_world"], runs, actor["reach"])
