"""The pixels of tiles."""

from typing import no_type_check

import triton
import triton.language as tl

TILE = tl.constexpr(16)
"""Edge of a tile in pixels."""


@triton.jit
@no_type_check
def tile_pixels(tile, width, height, across, per_camera):
    """The indices of a tile's pixels among those of all cameras, and which of them are in the image."""
    pixel = tl.arange(0, TILE * TILE)
    camera, within = tile // per_camera, tile % per_camera
    x, y = within % across * TILE + pixel % TILE, within // across * TILE + pixel // TILE
    return (camera * height + y) * width + x, (x < width) & (y < height)
