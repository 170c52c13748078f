"""The tiles of a LiDAR scan and their borders, taken from the rays themselves: beams are not evenly spaced."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.scan_projection import wrapped

FIRINGS, BEAMS = 32, 8
"""Size of a tile in firings and beams."""


class ScanBorders(NamedTuple):
    """Borders in radians of a scan's tiles, in `rows` of 8 beams and `columns` of 32 firings.

    Rays of a tile lie within `half_widths` of the azimuth `centers`, also across ±π. `order` lists the columns of each
    row by ascending centre. Elevations lie between `lows` and `highs` of the row; those of a tile's beam k between
    `beam_lows` and `beam_highs` [:, :, k].
    """

    centers: Float[Tensor, "rows columns"]
    half_widths: Float[Tensor, "rows columns"]
    order: Int[Tensor, "rows columns"]
    lows: Float[Tensor, " rows"]
    highs: Float[Tensor, " rows"]
    beam_lows: Float[Tensor, "rows columns 8"]
    beam_highs: Float[Tensor, "rows columns 8"]


def scan_borders(azimuths: Float[Tensor, "b a"], elevations: Float[Tensor, "b a"]) -> ScanBorders:
    """The borders, in float64, of a scan of at least one ray; azimuths within ±π."""
    azimuths, elevations = _in_tiles(azimuths.double()), _in_tiles(elevations.double())
    middle = azimuths[:, :, BEAMS // 2, FIRINGS // 2, None, None]
    around = wrapped(azimuths - middle)
    low, high = around.amin(dim=(2, 3)), around.amax(dim=(2, 3))
    centers = wrapped(middle[..., 0, 0] + 0.5 * (low + high))
    beam_lows, beam_highs = elevations.amin(dim=3), elevations.amax(dim=3)
    return ScanBorders(
        centers, 0.5 * (high - low), centers.argsort(dim=1), beam_lows.amin(dim=(1, 2)), beam_highs.amax(dim=(1, 2)),
        beam_lows, beam_highs,
    )  # fmt: skip


def _in_tiles(rays: Float[Tensor, "b a"]) -> Float[Tensor, "rows columns 8 32"]:
    """Values of rays by tile; incomplete tiles repeat the last beam and firing."""
    b, a = rays.shape
    rows, columns = -(-b // BEAMS), -(-a // FIRINGS)
    beam = torch.arange(rows * BEAMS, device=rays.device).clamp(max=b - 1)
    firing = torch.arange(columns * FIRINGS, device=rays.device).clamp(max=a - 1)
    return rays[beam][:, firing].reshape(rows, BEAMS, columns, FIRINGS).transpose(1, 2)
