"""Floaters: Gaussians where nothing is seen, since the ego vehicle drove through the space, or the road hides it."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.kernels.road_distance import Road
from drivesplat.kernels.sparse_grid import SparseGrid, dilated
from drivesplat.model.parameters import fade
from drivesplat.model.part import Part
from drivesplat.model.road import RoadPart

LARGEST_STEP = 15.0
"""Maximum distance in metres between consecutive positions that a path connects."""
PAIRS = 2**21
"""Number of pairs of points and segments per batch: 25 MB an array."""
MIN_EDGE = 0.5
"""Metres: the minimum edge of the cells around a path."""
ROUNDING = 0.01
"""Metres, more than the rounding of world coordinates in single precision."""


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
class SensorPath:
    """The space within `radius` metres of the path of sensors, from `starts` to `ends` (m, 3). Its `cells` hold all of
    it, and little else: only points in them are compared with the segments."""

    starts: Float[Tensor, "m 3"]
    ends: Float[Tensor, "m 3"]
    radius: float
    cells: SparseGrid

    @classmethod
    def of(cls, centers: Float[Tensor, "n 3"], radius: float) -> "SensorPath":
        """Around the path through the positions of sensors (metres), in time order; `radius` is greater than 0."""
        starts, ends = sensor_path(centers)
        cells = cells_around(starts.double().cpu().numpy(), ends.double().cpu().numpy(), radius)
        return cls(starts, ends, radius, cells.to(centers.device))

    def holds(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """The mask of points within it."""
        held = self.cells.lookup(points)[1]
        candidates = held.nonzero()[:, 0]
        held[candidates] = near_path(points[candidates], self.starts, self.ends, self.radius)
        return held


def cells_around(starts: Float[np.ndarray, "m 3"], ends: Float[np.ndarray, "m 3"], radius: float) -> SparseGrid:
    """Cells that hold all points within `radius` metres of any of the segments; on the CPU."""
    edge = max(radius, MIN_EDGE)
    counts = 1 + np.ceil(np.linalg.norm(ends - starts, axis=1) / (0.5 * edge)).astype(np.int64)
    segment = np.repeat(np.arange(len(starts)), counts)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    fraction = (number / np.maximum(counts[segment] - 1, 1))[:, None]
    samples = starts[segment] + fraction * (ends - starts)[segment]
    # each place of a segment is at most a quarter of an edge from a sample
    reach = int(np.ceil((radius + 0.25 * edge + ROUNDING) / edge))
    lower = samples.min(axis=0) - reach * edge
    shape = np.floor((samples.max(axis=0) - lower) / edge).astype(np.int64) + reach + 1
    cells = dilated(np.floor((samples - lower) / edge).astype(np.int64), shape, reach)
    return SparseGrid.from_numpy(lower, edge, shape, np.ravel_multi_index(cells.T, shape))


@dataclass(frozen=True)
class EmptySpace:
    """Space without Gaussians of static parts: along the `path` of sensors, below the `road`, and around the surface of
    the `road_part`, which alone has Gaussians there; each None where it is unknown or not wanted."""

    path: SensorPath | None = None
    road: Road | None = None
    road_part: RoadPart | None = None

    @property
    def known(self) -> bool:
        """Whether there is any such space."""
        return any(it is not None for it in (self.path, self.road, self.road_part))

    def holds(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """The mask of points in empty space."""
        held = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        if self.path is not None:
            held = held | self.path.holds(points)
        if self.road_part is not None:
            held = held | self.road_part.owns(points)
        return held if self.road is None else held | self.road.is_above(points)


@torch.no_grad()
def fade_floaters(part: Part, empty: EmptySpace) -> None:
    """Fades the Gaussians of a static part whose centres lie in empty space.

    Only centres count, whatever the size: the centre of a large flat Gaussian lies in the surface it shows.
    """
    fade(part.params, empty.holds(part.params["means"]))


def fade_in_empty_space(parts: Iterable[Part], empty: EmptySpace) -> None:
    """Fades the Gaussians of all static `parts`, the road's excepted, whose centres lie in empty space."""
    for part in (part for part in parts if not part.moves and part is not empty.road_part and empty.known):
        fade_floaters(part, empty)
