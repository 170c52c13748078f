"""A sparse regular grid: the cells of interest, and a lookup by points."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SparseGrid:
    """The listed cells of a grid of `shape` (d,) cells with edges of `edge` metres and lower corner `lower` (d,).

    `keys` (k,) are their sorted row-major indices in the grid.
    """

    lower: Float[Tensor, " d"]
    edge: float
    shape: tuple[int, ...]
    keys: Int[Tensor, " k"]

    @classmethod
    def from_numpy(cls, lower: np.ndarray, edge: float, shape: np.ndarray, keys: np.ndarray) -> "SparseGrid":
        """From arrays `lower` (d,), `shape` (d,) and `keys` (k,), ascending; on the CPU."""
        return cls(torch.from_numpy(lower).float(), float(edge), tuple(shape.tolist()), torch.from_numpy(keys))

    def to(self, device: torch.device) -> "SparseGrid":
        return replace(self, lower=self.lower.to(device), keys=self.keys.to(device))

    @torch.no_grad()
    def lookup(self, points: Float[Tensor, "n d"]) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
        """For each point the index into `keys` of its cell, and whether its cell is listed; otherwise the index is
        arbitrary. No host synchronisation."""
        if len(self.keys) == 0:
            none = torch.zeros(len(points), dtype=torch.long, device=points.device)
            return none, none.bool()
        cell, within = torch.floor((points - self.lower) / self.edge), None
        key = torch.zeros(len(points), dtype=torch.long, device=points.device)
        for axis, count in enumerate(self.shape):
            inside = (cell[:, axis] >= 0) & (cell[:, axis] < count)
            within = inside if within is None else within & inside
            key = key * count + torch.where(inside, cell[:, axis], 0.0).long()
        index = torch.searchsorted(self.keys, key).clamp(max=len(self.keys) - 1)
        return index, within & (self.keys[index] == key)


def dilated(cells: Int[np.ndarray, "n d"], shape: Int[np.ndarray, " d"], reach: int) -> Int[np.ndarray, "m d"]:
    """The `cells` of a grid of a shape, and all others whose index along every axis is within `reach` of that of one of
    them, in row-major order."""
    steps = np.arange(-reach, reach + 1)
    for axis, count in enumerate(shape):
        moved = np.repeat(cells, len(steps), axis=0)
        moved[:, axis] = np.clip(moved[:, axis] + np.tile(steps, len(cells)), 0, count - 1)
        cells = np.stack(np.unravel_index(np.unique(np.ravel_multi_index(moved.T, shape)), shape), axis=1)
    return cells
