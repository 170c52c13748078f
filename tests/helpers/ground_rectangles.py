"""Ground rectangles of the objects of a synthetic world, and which of them ever overlap."""

from itertools import combinations

import numpy as np

from drivesplat.world.recorder import Recorder, Viewpoint
from drivesplat.world.street.objects import StreetObject

EGO_CENTER, EGO_SIZE = 1.4, (4.6, 1.9)
"""Middle of the ego vehicle in metres ahead of its origin; its length and width."""
INTERVAL_S = 0.1


def rectangles(item: StreetObject, seconds: np.ndarray) -> np.ndarray:
    """Centre, forward half and left half (n, 3, 2) of an object's ground rectangle."""
    poses, size = item.poses(seconds), item.size
    halves = [poses[:, :2, 0] * size[0] / 2, poses[:, :2, 1] * size[1] / 2]
    return np.stack([poses[:, :2, 3], *halves], axis=1)


def gaps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The distance (n,) of two rectangles (n, 3, 2) along the axis that separates them best; negative if none does."""
    between, separations = b[:, 0] - a[:, 0], []
    for half in (a[:, 1], a[:, 2], b[:, 1], b[:, 2]):
        axis = half / np.linalg.norm(half, axis=1, keepdims=True)
        reach = sum(np.abs((h * axis).sum(axis=1)) for h in (a[:, 1], a[:, 2], b[:, 1], b[:, 2]))
        separations.append(np.abs((between * axis).sum(axis=1)) - reach)
    return np.max(separations, axis=0)


def ego_rectangle(recorder: Recorder, seconds: np.ndarray, edit: str | None = None) -> np.ndarray:
    """The same (n, 3, 2) of the ego vehicle."""
    poses = recorder.ego_to_street(seconds, Viewpoint(edit=edit))
    forward, left = poses[:, :2, 0], poses[:, :2, 1]
    halves = [forward * EGO_SIZE[0] / 2, left * EGO_SIZE[1] / 2]
    return np.stack([poses[:, :2, 3] + EGO_CENTER * forward, *halves], axis=1)


def meetings(recorder: Recorder, edit: str | None = None) -> list[str]:
    """A sentence for each pair of objects, the ego vehicle among them, whose rectangles overlap during the drive."""
    seconds = np.arange(0.0, recorder.world.seconds, INTERVAL_S)
    objects = recorder.variation(edit).street.objects
    boxed = {item.name: rectangles(item, seconds) for item in objects if item.category}
    boxed["ego vehicle"] = ego_rectangle(recorder, seconds, edit)
    found = []
    for (a, one), (b, other) in combinations(boxed.items(), 2):
        gap = gaps(one, other)
        if gap.min() <= 0.0:
            found.append(f"{a} meets {b} at {seconds[gap.argmin()]:.1f} s: {gap.min():.2f} m")
    return found
