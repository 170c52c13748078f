"""Points that the refinement of poses has triangulated, and which images see them: `triangulated.pkl`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.plain_pickle import read_plain_pickle
from drivesplat.io.storage import unreadable
from drivesplat.poses.observations import Observations

SHARP_PIXELS = 2.0
"""A point's mean reprojection error is under this."""
LEAST_VIEWS = 2
"""A point is a seed where so many training images see it."""
_KEYS = {"points", "seen_by", "seen_point"}


def triangulated_record(frames: Sequence[int], seen: Observations) -> dict[str, np.ndarray]:
    """The content of triangulated.pkl, where `frames` (n) are the images' numbers among the scene's frames: `points`
    (p, 3) in world metres; per observation the number of the frame `seen_by` (o,), and of the point `seen_point` (o,).
    Blurred points are left out."""
    count = np.bincount(seen.point, minlength=len(seen.positions))
    mean = np.bincount(seen.point, seen.error, minlength=len(seen.positions)) / np.maximum(count, 1)
    kept = (mean < SHARP_PIXELS) & (count > 0)
    renumbered = np.cumsum(kept) - 1
    of_kept = kept[seen.point]
    return {
        "points": seen.positions[kept],
        "seen_by": np.array(frames, dtype=np.int64)[seen.image[of_kept]],
        "seen_point": renumbered[seen.point[of_kept]],
    }


def no_points() -> dict[str, np.ndarray]:
    """The content of triangulated.pkl where poses stay as they were."""
    none = np.empty(0, dtype=np.int64)
    return {"points": np.empty((0, 3)), "seen_by": none, "seen_point": none}


def read_triangulated(path: str | Path) -> dict[str, Any]:
    """Reads `triangulated.pkl`. Raises ResultError where it is not one."""
    content = read_plain_pickle(path, rule="refine_poses")
    if not isinstance(content, dict) or not content.keys() >= _KEYS:
        raise unreadable(path, "refine_poses", "it lacks the keys of triangulated points")
    return content


def seen_in(record: dict[str, np.ndarray], images: np.ndarray) -> np.ndarray:
    """Which points (p,) bool at least LEAST_VIEWS of `images` (numbers of frames) see."""
    return _views(record, images) >= LEAST_VIEWS


def mean_over_views(record: dict[str, np.ndarray], images: np.ndarray, values: np.ndarray) -> np.ndarray:
    """For each point (p,) the mean of `values` (n,), one per frame of the scene, over those of `images` that see it; 0
    where none does."""
    chosen = np.isin(record["seen_by"], images)
    weights = values[record["seen_by"][chosen]]
    sums = np.bincount(record["seen_point"][chosen], weights, minlength=len(record["points"]))
    return sums / np.maximum(_views(record, images), 1)


def _views(record: dict[str, np.ndarray], images: np.ndarray) -> np.ndarray:
    """How many of `images` see each point (p,)."""
    return np.bincount(record["seen_point"][np.isin(record["seen_by"], images)], minlength=len(record["points"]))
