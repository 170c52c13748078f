"""A surface by its heights over a horizontal grid, such as that of a road."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class HeightSamples(NamedTuple):
    """Heights (metres) of a surface at n places, and its slopes along x and y (metres per metre)."""

    heights: Float[Tensor, " n"]
    slopes: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class HeightField:
    """`heights` (metres) of a surface at the nodes of a grid along x and y with edges of `edge` metres, the first of
    which is at `lower`, bilinear between them; `covered` are the cells in which it is known."""

    lower: Float[Tensor, "2"]
    edge: float
    heights: Float[Tensor, "x y"]
    covered: Bool[Tensor, "x_less_1 y_less_1"]

    def at(self, places: Float[Tensor, "n 2"]) -> HeightSamples:
        """The surface at places (metres); beyond the grid that of the cells at its edge continues. Heights have a
        gradient for places and nodes. Does not synchronise with the device.

        >>> slope = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
        >>> field = HeightField(torch.zeros(2), 2.0, slope, torch.ones(1, 1, dtype=torch.bool))
        >>> field.at(torch.tensor([[0.5, 1.0]]))
        HeightSamples(heights=tensor([0.2500]), slopes=tensor([[0.5000, 0.0000]]))
        """
        columns = self.heights.shape[1]
        along, cell = self._cells(places)
        x, y = (along - cell).unbind(dim=1)
        first, nodes = cell[:, 0] * columns + cell[:, 1], self.heights.flatten()
        low, in_y, in_x, far = (nodes.index_select(0, first + step) for step in (0, 1, columns, columns + 1))
        in_x, in_y, both = in_x - low, in_y - low, far - in_x - in_y + low
        slopes = torch.stack([in_x + y * both, in_y + x * both], dim=1) / self.edge
        return HeightSamples(low + x * in_x + y * in_y + x * y * both, slopes)

    @torch.no_grad()
    def covers(self, places: Float[Tensor, "n 2"]) -> Bool[Tensor, " n"]:
        """Whether places lie in cells in which the surface is known. Does not synchronise with the device."""
        along, cell = self._cells(places)
        inside = ((along - cell >= 0.0) & (along - cell <= 1.0)).all(dim=1)
        return inside & self.covered.flatten().index_select(0, cell[:, 0] * self.covered.shape[1] + cell[:, 1])

    @torch.no_grad()
    def sums(self, places: Float[Tensor, "n 2"], values: Float[Tensor, " n"]) -> Float[Tensor, "x_less_1 y_less_1"]:
        """The sums of the values at places in each cell; places beyond the grid count in the cell nearest to them."""
        _, cell = self._cells(places)
        found = values.new_zeros(self.covered.numel())
        found.index_add_(0, cell[:, 0] * self.covered.shape[1] + cell[:, 1], values)
        return found.reshape(self.covered.shape)

    @torch.no_grad()
    def layer(self, points: Float[Tensor, "n 3"], below: float, above: float) -> Bool[Tensor, " n"]:
        """Whether points (metres) lie less than `below` metres below the known surface, or `above` metres above it."""
        over = points[:, 2] - self.at(points[:, :2]).heights
        return self.covers(points[:, :2]) & (over > -below) & (over < above)

    def _cells(self, places: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 2"], Int[Tensor, "n 2"]]:
        """Places in units of edges from the first node, and the nearest cells of the grid."""
        along = (places - self.lower) / self.edge
        x, y = along.detach().floor().long().unbind(dim=1)
        limits = (count - 1 for count in self.covered.shape)
        return along, torch.stack([at.clamp(0, limit) for at, limit in zip((x, y), limits, strict=True)], dim=1)
