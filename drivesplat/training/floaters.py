"""Floaters: Gaussians where nothing is, since the recording car drove there, or rays went through."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.model.part import Part
from drivesplat.training.sparse_grid import SparseGrid

LARGEST_STEP = 15.0
"""Camera positions farther apart than this (metres) are not joined into a path."""
PAIRS = 2**21
"""Points by segments that are looked at together: 25 MB an array."""


def camera_path(centers: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Starts and ends of the segments between consecutive camera positions, in time order.

    A lone position is a segment of no length.
    """
    starts, ends = centers[:-1], centers[1:]
    joined = (ends - starts).norm(dim=1) < LARGEST_STEP
    return torch.cat([starts[joined], centers]), torch.cat([ends[joined], centers])


def near_path(
    points: Float[Tensor, "n 3"], starts: Float[Tensor, "m 3"], ends: Float[Tensor, "m 3"], radius: float
) -> Bool[Tensor, " n"]:
    """Which points are nearer than `radius` metres to any of the segments."""
    along = ends - starts
    squared = along.square().sum(dim=1).clamp(min=1e-12)
    near = []
    for some in points.split(max(1, PAIRS // max(1, len(starts)))):
        offsets = some[:, None] - starts
        fractions = ((offsets * along).sum(dim=2) / squared).clamp(0.0, 1.0)
        distances = (offsets - fractions[..., None] * along).square().sum(dim=2)
        near.append((distances < radius**2).any(dim=1))
    return torch.cat(near)


@dataclass(frozen=True)
class EmptySpace:
    """Where nothing stands: within `radius` metres (0: nowhere) of the cameras' path from `starts` to `ends` (m, 3),
    and in the cells of `free`, world metres (None: in none)."""

    starts: Float[Tensor, "m 3"]
    ends: Float[Tensor, "m 3"]
    radius: float
    free: SparseGrid | None = None

    @property
    def known(self) -> bool:
        """Whether there is any such place."""
        return self.radius > 0 or self.free is not None

    def holds(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which points lie there."""
        segments = (self.starts, self.ends) if self.radius > 0 else (self.starts[:0], self.ends[:0])
        near = near_path(points, *segments, self.radius)
        return near if self.free is None else near | self.free.lookup(points)[1]


@torch.no_grad()
def fade_floaters(part: Part, empty: EmptySpace) -> None:
    """Fades the Gaussians of a part that stands still whose centres lie in empty space.

    Centres decide, whatever a Gaussian's size: one that is large and flat has its centre in what it shows. Where rays
    leave room around what they met, a wall's Gaussians do not reach; one whose centre is that far out shows something
    in the air, whatever it covers behind.
    """
    part.fade(empty.holds(part.params["means"]))
