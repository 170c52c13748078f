"""Floaters: Gaussians where nothing is seen, since the ego vehicle drove or LiDAR rays passed through the space, or the
road hides it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.model.part import Part

LARGEST_STEP = 15.0
"""Maximum distance in metres between consecutive positions that a path connects."""
PAIRS = 2**21
"""Number of pairs of points and segments per batch: 25 MB an array."""


def sensor_path(centers: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Starts and ends of the segments between consecutive positions of cameras or LiDARs, in time order.

    An isolated position is a segment of length 0.
    """
    starts, ends = centers[:-1], centers[1:]
    joined = (ends - starts).norm(dim=1) < LARGEST_STEP
    return torch.cat([starts[joined], centers]), torch.cat([ends[joined], centers])


def near_path(
    points: Float[Tensor, "n 3"], starts: Float[Tensor, "m 3"], ends: Float[Tensor, "m 3"], radius: float
) -> Bool[Tensor, " n"]:
    """The mask of points nearer than `radius` metres to any of the segments."""
    along = ends - starts
    squared = along.square().sum(dim=1).clamp(min=1e-12)
    near = []
    for batch in points.split(max(1, PAIRS // max(1, len(starts)))):
        offsets = batch[:, None] - starts
        fractions = ((offsets * along).sum(dim=2) / squared).clamp(0.0, 1.0)
        distances = (offsets - fractions[..., None] * along).square().sum(dim=2)
        near.append((distances < radius**2).any(dim=1))
    return torch.cat(near)


@dataclass(frozen=True)
class EmptySpace:
    """Space in which nothing is seen: within `radius` metres (0: none) of the path of sensors from `starts` to `ends`
    (m, 3), the cells of `free` in world metres (None: none), and below the `road` (None: unknown)."""

    starts: Float[Tensor, "m 3"]
    ends: Float[Tensor, "m 3"]
    radius: float
    free: SparseGrid | None = None
    road: Road | None = None

    @property
    def known(self) -> bool:
        """Whether any space is known to be empty."""
        return self.radius > 0 or self.free is not None or self.road is not None

    def holds(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """The mask of points in empty space."""
        segments = (self.starts, self.ends) if self.radius > 0 else (self.starts[:0], self.ends[:0])
        held = near_path(points, *segments, self.radius)
        if self.free is not None:
            held = held | self.free.lookup(points)[1]
        return held if self.road is None else held | self.road.is_above(points)


@torch.no_grad()
def fade_floaters(part: Part, empty: EmptySpace) -> None:
    """Fades the Gaussians of a static part whose centres lie in empty space.

    Only centres count, whatever the size: the centre of a large flat Gaussian lies in the surface it shows. Free space
    keeps a margin around LiDAR returns, so a centre inside it belongs to no surface.
    """
    part.fade(empty.holds(part.params["means"]))
