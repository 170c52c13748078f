"""Points triangulated by the refinement of poses, their observations, and triangulated.npz, which stores both."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance, no_provenance

RULE = "refine_poses"
MAX_MEAN_ERROR = 2.0
"""Maximum mean reprojection error of a point in pixels."""
MIN_VIEWS = 2
"""Minimum number of training images that see a point that becomes a seed."""


@dataclass(frozen=True)
class Observations:
    """The o observations of p points. Per observation: `image` and `point` (o,), indices in the order of pycolmap's
    numbers, and the reprojection `error` (o,) in pixels, infinite behind the camera. Per point: `positions` (p, 3),
    world metres, and pycolmap's `numbers` (p,)."""

    image: np.ndarray
    point: np.ndarray
    error: np.ndarray
    positions: np.ndarray
    numbers: np.ndarray


@dataclass(frozen=True)
class TriangulatedPoints:
    """The content of triangulated.npz: p `points` in world metres, and for each of o observations the index of its
    frame in the scene (`seen_by`) and of its point (`seen_point`)."""

    points: Float[np.ndarray, "p 3"]
    seen_by: Int[np.ndarray, " o"]
    seen_point: Int[np.ndarray, " o"]
    provenance: Provenance = field(default_factory=no_provenance)

    def seen_in(self, images: np.ndarray) -> Bool[np.ndarray, " p"]:
        """Whether at least MIN_VIEWS of `images` (indices of frames) see each point."""
        return self._views(images) >= MIN_VIEWS

    def mean_over_views(self, images: np.ndarray, values: np.ndarray) -> Float[np.ndarray, " p"]:
        """For each point the mean of `values` (n,), one per frame of the scene, over those of `images` that see it, 0
        without any."""
        chosen = np.isin(self.seen_by, images)
        weights = values[self.seen_by[chosen]]
        sums = np.bincount(self.seen_point[chosen], weights, minlength=len(self.points))
        return sums / np.maximum(self._views(images), 1)

    def _views(self, images: np.ndarray) -> Int[np.ndarray, " p"]:
        """How many of `images` see each point."""
        return np.bincount(self.seen_point[np.isin(self.seen_by, images)], minlength=len(self.points))


def triangulated_points(frames: Sequence[int], observations: Observations) -> TriangulatedPoints:
    """The points with a mean error below MAX_MEAN_ERROR. `frames` (n,): the index of each image in the scene."""
    number = len(observations.positions)
    count = np.bincount(observations.point, minlength=number)
    total_error = np.bincount(observations.point, observations.error, minlength=number)
    kept = (total_error / np.maximum(count, 1) < MAX_MEAN_ERROR) & (count > 0)
    renumbered = np.cumsum(kept) - 1
    of_kept = kept[observations.point]
    return TriangulatedPoints(
        points=observations.positions[kept],
        seen_by=np.array(frames, dtype=np.int64)[observations.image[of_kept]],
        seen_point=renumbered[observations.point[of_kept]],
    )


def no_points() -> TriangulatedPoints:
    """The record of a drive without triangulated points."""
    none = np.empty(0, dtype=np.int64)
    return TriangulatedPoints(np.empty((0, 3)), none, none)


def read_triangulated(path: str | Path) -> TriangulatedPoints:
    """Reads triangulated.npz. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    return read_typed_arrays(path, RULE, TriangulatedPoints, "triangulated points")
