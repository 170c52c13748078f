"""The depth of the surfaces that an image shows, tile by tile (`drivesplat.kernels.surface_depth`)."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.cache import fast_callee, kernel
from drivesplat.kernels.numba import layout
from drivesplat.kernels.numba.layout import CHUNK
from drivesplat.kernels.numba.pixels import (
    CHECK_EVERY,
    OUT,
    PIXELS,
    WEIGHT,
    X,
    Y,
    begin_tile,
    ended,
    reached_rows,
    start_of,
    weigh,
)
from drivesplat.kernels.numba.projection import NEAR_PLANE, arrays
from drivesplat.kernels.numba.threads import parallel_for
from drivesplat.kernels.numba.tiles import front_to_back, grid, tile_lists

HALF, PASSED, DEPTH = range(OUT, OUT + 3)
"""Planes of half of the final alpha, of the weights passed so far, and of the depth found."""


def surface_depth(
    means2d: Float[Tensor, "n 2"],
    depths: Float[Tensor, " n"],
    conics: Float[Tensor, "n 3"],
    radii: Int[Tensor, "n 2"],
    opacities: Float[Tensor, " n"],
    planes: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """The depth in metres at which the rays of one camera have passed half of `alpha`; 0 where they meet nothing."""
    found = torch.zeros_like(alpha)
    splats = front_to_back(*arrays(means2d, depths, conics, opacities, radii, planes))
    columns, rows = grid(alpha.shape[1], alpha.shape[0])
    for lists in tile_lists(splats, columns, rows):
        parallel_for(
            _surface_depths, lists.last - lists.first, CHUNK,
            lists.first, lists.offsets, lists.ranks, splats.shapes, splats.values, columns, *arrays(alpha, found),
        )  # fmt: skip
    return found


@kernel
@no_type_check
def _surface_depths(start, stop, first, offsets, ranks, shapes, planes, columns, alpha, depth):
    """Writes the depths (h, w) of tiles first + start to first + stop."""
    height, width = depth.shape
    s = np.empty((DEPTH + 1) * PIXELS, depth.dtype)
    for tile in range(start, stop):
        x0, y0 = (first + tile) % columns * layout.TILE_WIDTH, (first + tile) // columns * layout.TILE_HEIGHT
        begin_tile(s, x0, y0, width, height)
        s[HALF * PIXELS :] = 0.0
        for y in range(y0, min(y0 + layout.TILE_HEIGHT, height)):
            for x in range(x0, min(x0 + layout.TILE_WIDTH, width)):
                p = (y - y0) * layout.TILE_WIDTH + x - x0
                s[HALF * PIXELS + p] = depth.dtype.type(0.5) * alpha[y, x]
        for i in range(offsets[tile], offsets[tile + 1]):
            if (i - offsets[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and ended(s):
                break
            r = ranks[i]
            begin, end = reached_rows(shapes[r], x0, y0)
            weigh(s, begin, end, shapes[r])
            _pass(s, begin, end, shapes[r], planes[r])
        for y in range(y0, min(y0 + layout.TILE_HEIGHT, height)):
            for x in range(x0, min(x0 + layout.TILE_WIDTH, width)):
                depth[y, x] = s[DEPTH * PIXELS + (y - y0) * layout.TILE_WIDTH + x - x0]


@fast_callee
@no_type_check
def _pass(s, begin, end, shape, plane):
    """Adds the weights of one Gaussian to those passed, and writes its depth where they reach half of alpha."""
    near = s.dtype.type(NEAR_PLANE)
    for p in range(begin, end):
        before = s[start_of(PASSED) + p]
        after = before + s[start_of(WEIGHT) + p]
        middle = s[start_of(HALF) + p]
        over_x, over_y = s[start_of(X) + p] - shape[layout.MEAN_X], s[start_of(Y) + p] - shape[layout.MEAN_Y]
        depth = plane[0] + plane[1] * over_x + plane[2] * over_y
        depth = depth if depth > near else near
        s[start_of(DEPTH) + p] = depth if (before < middle) & (after >= middle) else s[start_of(DEPTH) + p]
        s[start_of(PASSED) + p] = after
