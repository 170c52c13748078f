"""Cells of a grid that are told apart, looked up by the thousand where the Gaussians are."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Cells:
    """Some of the cells, of edge `edge` in metres, of a grid of `shape` (d,) cells whose lower corner is `lower` (d,).

    They are the sorted `keys` (k,): row-major places in the grid.
    """

    lower: Float[Tensor, " d"]
    edge: float
    shape: tuple[int, ...]
    keys: Int[Tensor, " k"]

    @classmethod
    def of(cls, lower: np.ndarray, edge: float, shape: np.ndarray, keys: np.ndarray) -> "Cells":
        """Of arrays `lower` (d,), `shape` (d,) and `keys` (k,), ascending; on the CPU."""
        return cls(torch.from_numpy(lower).float(), float(edge), tuple(shape.tolist()), torch.from_numpy(keys))

    def to(self, device: torch.device) -> "Cells":
        return replace(self, lower=self.lower.to(device), keys=self.keys.to(device))

    @torch.no_grad()
    def find(self, points: Float[Tensor, "n d"]) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
        """Which of the cells points lie in, as places in `keys`, and whether they lie in one; elsewhere the place is
        some other. Nothing waits for the device."""
        if len(self.keys) == 0:
            nowhere = torch.zeros(len(points), dtype=torch.long, device=points.device)
            return nowhere, nowhere.bool()
        cell, within = torch.floor((points - self.lower) / self.edge), None
        key = torch.zeros(len(points), dtype=torch.long, device=points.device)
        for axis, count in enumerate(self.shape):
            inside = (cell[:, axis] >= 0) & (cell[:, axis] < count)
            within = inside if within is None else within & inside
            key = key * count + torch.where(inside, cell[:, axis], 0.0).long()
        place = torch.searchsorted(self.keys, key).clamp(max=len(self.keys) - 1)
        return place, within & (self.keys[place] == key)
