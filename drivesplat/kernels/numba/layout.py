"""The layout of arrays that the kernels of the CPU rasterizer share."""

from dataclasses import dataclass

import numpy as np

TILE_WIDTH = 16
TILE_HEIGHT = 16
"""Size of a tile in pixels."""
CHUNK = 8
"""Tiles per chunk: few, so that threads finish at the same time."""
MIN_ALPHA = 1.0 / 255.0
"""Minimum alpha: smaller contributions are not drawn."""
SLACK = 0.02
"""Margin of ellipses in pixels, larger than any float32 rounding error."""
MEAN_X, MEAN_Y, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, REACH, RADIUS_X, RADIUS_Y = range(9)
"""Columns of `Splats.shapes`. A Gaussian is drawn where its exponent's quadratic form is at most REACH."""
MOMENTS = 6
"""First columns of an entry's gradients: those of the exponent times 1, dx, dy, dx², dx dy and dy². The channels'
follow."""


@dataclass(frozen=True)
class NumbaTileLists:
    """The Gaussians of tiles `first` to `last` (excluded) of an image or a LiDAR scan, in rows of tiles.

    Those of tile t are `ranks[offsets[t - first] : offsets[t - first + 1]]`, as rows of `shapes`, front to back.
    Entry i has place `slots[i]` in a numbering by Gaussian; those of Gaussian r are
    `slot_offsets[r]` to `slot_offsets[r + 1]` (excluded).
    """

    first: int
    last: int
    offsets: np.ndarray
    ranks: np.ndarray
    slots: np.ndarray
    slot_offsets: np.ndarray
