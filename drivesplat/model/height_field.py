"""A surface by its heights over a horizontal grid, such as that of a road."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class HeightField:
    """`heights` (metres) of a surface at the nodes of a grid along x and y with edges of `edge` metres, the first of
    which is at `lower`, bilinear between them; `covered` are the cells in which it is known."""

    lower: Float[Tensor, "2"]
    edge: float
    heights: Float[Tensor, "x y"]
    covered: Bool[Tensor, "x_less_1 y_less_1"]

    def at(self, places: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """The heights at places (metres); beyond the grid the surface of the cells at its edge continues. They have a
        gradient for places and nodes. Does not synchronise with the device.

        >>> slope = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
        >>> field = HeightField(torch.zeros(2), 2.0, slope, torch.ones(1, 1, dtype=torch.bool))
        >>> field.at(torch.tensor([[0.5, 1.0]]))
        tensor([0.2500])
        """
        cells, inside = self.locate(places)
        return bilinear(self.tiles().index_select(0, cells), inside)

    def tiles(self) -> Float[Tensor, "cells 4"]:
        """The coefficients of the surface in each cell, row by row, for `bilinear`."""
        low, in_y, in_x, far = (part.flatten() for part in _corners(self.heights))
        return torch.stack([low, in_x - low, in_y - low, far - in_x - in_y + low], dim=1)

    def locate(self, places: Float[Tensor, "n 2"]) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 2"]]:
        """The cells, counted row by row, that are nearest to places (metres), and the places in them in units of edges.
        Does not synchronise with the device."""
        along = (places - self.lower) / self.edge
        rows, columns = self.covered.shape
        x, y = along.detach().floor().unbind(dim=1)
        x, y = x.clamp(0, rows - 1), y.clamp(0, columns - 1)
        return (x.long() * columns).add_(y.long()), along - torch.stack([x, y], dim=1)

    @torch.no_grad()
    def covers(self, places: Float[Tensor, "n 2"]) -> Bool[Tensor, " n"]:
        """Whether places lie in cells in which the surface is known. Does not synchronise with the device."""
        cells, inside = self.locate(places)
        return ((inside >= 0.0) & (inside <= 1.0)).all(dim=1) & self.covered.flatten().index_select(0, cells)

    @torch.no_grad()
    def sums(self, places: Float[Tensor, "n 2"], values: Float[Tensor, " n"]) -> Float[Tensor, "x_less_1 y_less_1"]:
        """The sums of the values at places in each cell; places beyond the grid count in the cell nearest to them."""
        found = values.new_zeros(self.covered.numel())
        found.index_add_(0, self.locate(places)[0], values)
        return found.reshape(self.covered.shape)

    @torch.no_grad()
    def layer(self, points: Float[Tensor, "n 3"], below: float, above: float) -> Bool[Tensor, " n"]:
        """Whether points (metres) lie less than `below` metres below the known surface, or `above` metres above it."""
        over = points[:, 2] - self.at(points[:, :2])
        return self.covers(points[:, :2]) & (over > -below) & (over < above)


def bilinear(tiles: Float[Tensor, "n 4"], inside: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    """Heights at places in cells (`HeightField.locate`) with these coefficients (`HeightField.tiles`)."""
    (low, in_x, in_y, both), (x, y) = tiles.unbind(dim=1), inside.unbind(dim=1)
    return torch.addcmul(torch.addcmul(low, y, in_y), x, torch.addcmul(in_x, y, both))


def _corners(nodes: Float[Tensor, "x y"]) -> tuple[Float[Tensor, "x_less_1 y_less_1"], ...]:
    """The values at the four nodes of each cell: the first, the next along y, the next along x, the last."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
