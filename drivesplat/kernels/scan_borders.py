"""The tiles of a LiDAR scan and their borders, taken from the rays themselves: beams are not evenly spaced."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.scanned_gaussians import wrapped


class TileSize(NamedTuple):
    """The rays of a tile: `beams` times `firings`."""

    beams: int
    firings: int


ON_CPU, ON_GPU = TileSize(beams=8, firings=32), TileSize(beams=1, firings=32)
BINS = 4096
"""Intervals of azimuth in which `TileTable` looks up tiles."""


class ScanBorders(NamedTuple):
    """Borders in radians of a scan's tiles, in `rows` of k beams and `columns` of firings.

    Rays of a tile lie within `half_widths` of the azimuth `centers`, also across ±π. `order` lists the columns of each
    row by ascending centre. Elevations lie between `lows` and `highs` of the row; those of a tile's beam i between
    `beam_lows` and `beam_highs` [:, :, i].
    """

    centers: Float[Tensor, "rows columns"]
    half_widths: Float[Tensor, "rows columns"]
    order: Int[Tensor, "rows columns"]
    lows: Float[Tensor, " rows"]
    highs: Float[Tensor, " rows"]
    beam_lows: Float[Tensor, "rows columns k"]
    beam_highs: Float[Tensor, "rows columns k"]


class TileTable(NamedTuple):
    """The tiles that an ellipse may reach, by its elevations and by the bins of azimuth in which it begins and ends.

    Rows of tiles are listed by ascending elevation, and the tiles of a row by ascending azimuth: `tiles` are their
    numbers in the scan. Rows that an interval of elevations reaches begin with the first whose `highs` is not below
    it, and end with the last whose `lows` is not above it (radians). Places in a row are counted on from turn to turn;
    those reached from bin i on begin at `first` [:, i], and those reached up to bin j end with `last` [:, j], which is
    one below where there is none.
    """

    tiles: Int[Tensor, "rows columns"]
    first: Int[Tensor, "rows bins"]
    last: Int[Tensor, "rows bins"]
    lows: Float[Tensor, " rows"]
    highs: Float[Tensor, " rows"]


def tile_table(azimuths: Float[Tensor, "b a"], elevations: Float[Tensor, "b a"], size: TileSize) -> TileTable:
    """The table of a scan of at least one ray; azimuths within ±π."""
    borders = scan_borders(azimuths, elevations, size)
    rows = (borders.lows + borders.highs).argsort()
    centers, widths, order = (values[rows] for values in (borders.centers, borders.half_widths, borders.order))
    count = centers.shape[1]
    turns = torch.arange(-1, 2, device=azimuths.device) * 2.0 * math.pi
    centers = (centers.gather(1, order)[:, None] + turns[:, None]).flatten(1)  # three turns
    widths = widths.gather(1, order).repeat(1, 3)
    lows, highs = _ascending(centers - widths, centers + widths)
    edges = torch.linspace(-math.pi, math.pi, BINS + 1, dtype=centers.dtype, device=centers.device)
    first = torch.searchsorted(highs, edges[:-1].expand(len(rows), -1).contiguous()) - count
    last = torch.searchsorted(lows, edges[1:].expand(len(rows), -1).contiguous(), right=True) - 1 - count
    bottoms, tops = _ascending(borders.lows[rows], borders.highs[rows])
    tiles = rows[:, None] * count + order
    return TileTable(tiles.int(), first.int(), last.int(), bottoms.to(elevations), tops.to(elevations))


def _ascending(
    lows: Float[Tensor, "*n"], highs: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Intervals whose ends ascend. Some lie within others, as where a revolution is longer than a turn: these grow."""
    return lows.flip(-1).cummin(dim=-1).values.flip(-1), highs.cummax(dim=-1).values


def scan_borders(azimuths: Float[Tensor, "b a"], elevations: Float[Tensor, "b a"], size: TileSize) -> ScanBorders:
    """The borders, in float64, of a scan of at least one ray; azimuths within ±π."""
    azimuths, elevations = _in_tiles(azimuths.double(), size), _in_tiles(elevations.double(), size)
    middle = azimuths[:, :, size.beams // 2, size.firings // 2, None, None]
    around = wrapped(azimuths - middle)
    low, high = around.amin(dim=(2, 3)), around.amax(dim=(2, 3))
    centers = wrapped(middle[..., 0, 0] + 0.5 * (low + high))
    beam_lows, beam_highs = elevations.amin(dim=3), elevations.amax(dim=3)
    return ScanBorders(
        centers, 0.5 * (high - low), centers.argsort(dim=1), beam_lows.amin(dim=(1, 2)), beam_highs.amax(dim=(1, 2)),
        beam_lows, beam_highs,
    )  # fmt: skip


def _in_tiles(rays: Float[Tensor, "b a"], size: TileSize) -> Float[Tensor, "rows columns k f"]:
    """Values of rays by tile; incomplete tiles repeat the last beam and firing."""
    b, a = rays.shape
    rows, columns = -(-b // size.beams), -(-a // size.firings)
    beam = torch.arange(rows * size.beams, device=rays.device).clamp(max=b - 1)
    firing = torch.arange(columns * size.firings, device=rays.device).clamp(max=a - 1)
    return rays[beam][:, firing].reshape(rows, size.beams, columns, size.firings).transpose(1, 2)
