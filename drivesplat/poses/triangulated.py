"""Points that the refinement of poses has triangulated, and which images see them, as triangulated.npz holds them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from drivesplat.io.array_file import read_arrays, write_arrays
from drivesplat.io.storage import Provenance, unreadable
from drivesplat.io.typed_record import typed_record
from drivesplat.poses.observations import Observations

RULE = "refine_poses"
MAX_MEAN_ERROR = 2.0
"""Maximum mean reprojection error of a point in pixels."""
MIN_VIEWS = 2
"""Minimum number of training images that see a point that becomes a seed."""


@dataclass(frozen=True)
class TriangulatedPoints:
    """The content of triangulated.npz: p `points` in world metres, and for each of o observations the index of the
    frame, among the scene's, that makes it (`seen_by`) and of the point (`seen_point`)."""

    points: Float[np.ndarray, "p 3"]
    seen_by: Int[np.ndarray, " o"]
    seen_point: Int[np.ndarray, " o"]
    provenance: Provenance = field(default_factory=dict)

    def seen_in(self, images: np.ndarray) -> Bool[np.ndarray, " p"]:
        """Whether at least MIN_VIEWS of `images` (indices of frames) see each point."""
        return self._views(images) >= MIN_VIEWS

    def mean_over_views(self, images: np.ndarray, values: np.ndarray) -> Float[np.ndarray, " p"]:
        """For each point the mean of `values` (n,), one per frame of the scene, over those of `images` that see it; 0
        where none does."""
        chosen = np.isin(self.seen_by, images)
        weights = values[self.seen_by[chosen]]
        sums = np.bincount(self.seen_point[chosen], weights, minlength=len(self.points))
        return sums / np.maximum(self._views(images), 1)

    def _views(self, images: np.ndarray) -> Int[np.ndarray, " p"]:
        """How many of `images` see each point."""
        return np.bincount(self.seen_point[np.isin(self.seen_by, images)], minlength=len(self.points))


def triangulated_points(frames: Sequence[int], seen: Observations) -> TriangulatedPoints:
    """The triangulated points, where `frames` (n,) are the indices of the images among the scene's frames. Points with
    a mean error of MAX_MEAN_ERROR or more are left out."""
    count = np.bincount(seen.point, minlength=len(seen.positions))
    mean = np.bincount(seen.point, seen.error, minlength=len(seen.positions)) / np.maximum(count, 1)
    kept = (mean < MAX_MEAN_ERROR) & (count > 0)
    renumbered = np.cumsum(kept) - 1
    of_kept = kept[seen.point]
    return TriangulatedPoints(
        points=seen.positions[kept],
        seen_by=np.array(frames, dtype=np.int64)[seen.image[of_kept]],
        seen_point=renumbered[seen.point[of_kept]],
    )


def no_points() -> TriangulatedPoints:
    """The record of poses that stay as they were."""
    none = np.empty(0, dtype=np.int64)
    return TriangulatedPoints(np.empty((0, 3)), none, none)


def write_triangulated(path: str | Path, record: TriangulatedPoints) -> None:
    """Writes triangulated.npz."""
    write_arrays(path, vars(record))


def read_triangulated(path: str | Path) -> TriangulatedPoints:
    """Reads triangulated.npz. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    content = read_arrays(path, RULE)
    try:
        return typed_record(TriangulatedPoints, content)
    except (TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of triangulated points ({error})") from error
