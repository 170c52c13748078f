"""Lists of the Gaussians in each tile of an image, front to back.

A tile lists a Gaussian where the ellipse within which its alpha is at least 1/255 reaches the centre of one of the
tile's pixels. These are fewer tiles than its bounding box covers.
"""

from typing import NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.capacity import capacity_for
from drivesplat.kernels.triton.pixels import TILE

BLOCK = 128
"""Gaussians per program."""
MIN_ALPHA = tl.constexpr(1.0 / 255.0)
"""Minimum alpha: smaller contributions are not rasterized, as in 3D Gaussian Splatting."""
SLACK = tl.constexpr(0.01)
"""Pixels by which ellipses are enlarged against rounding."""


class Footprints(NamedTuple):
    """n Gaussians in the images of c cameras: `means` in pixels, `conics`, the upper triangles of inverse covariances,
    and the `values` to composite."""

    means: Float[Tensor, "c n 2"]
    conics: Float[Tensor, "c n 3"]
    values: Float[Tensor, "c n v"]
    opacities: Float[Tensor, "c n"]


class TileLists(NamedTuple):
    """The Gaussians of every tile. Tiles are numbered by camera, row and column, Gaussians through all cameras.
    `ids[order[offsets[t] : offsets[t + 1]]]` are those of tile t, front to back; entries of `order` beyond the last
    offset are undefined. `tiles` are the numbers of cameras, rows and columns."""

    ids: Int[Tensor, " p"]
    order: Int[Tensor, " p"]
    offsets: Int[Tensor, " t"]
    tiles: tuple[int, int, int]


@torch.no_grad()
def tile_lists(
    gaussians: Footprints,
    radii: Int[Tensor, "c n 2"],
    depths: Float[Tensor, "c n"],
    width: int,
    height: int,
) -> TileLists:
    """The lists of all tiles of c images. `radii` are 0 out of view, `depths` in metres. Where the planned capacity
    (`drivesplat.kernels.capacity`) is too small, the farthest Gaussians are left out."""
    means, conics, opacities = (
        tensor.contiguous() for tensor in (gaussians.means, gaussians.conics, gaussians.opacities)
    )
    cameras, each = opacities.shape
    down, across = triton.cdiv(height, TILE.value), triton.cdiv(width, TILE.value)
    tiles, count = cameras * down * across, cameras * each
    counts, nearness = radii.new_empty(count), means.new_empty(count)
    seen, size = (means, conics, opacities, radii.contiguous()), (width, height, across, down * across)
    blocks = (triton.cdiv(count, BLOCK),)
    if count:
        _count_tiles[blocks](*seen, depths.contiguous(), counts, nearness, count, *size[:2], BLOCK)
    nearest = torch.argsort(nearness)
    ends = torch.cumsum(counts[nearest], dim=0, dtype=torch.int32)
    capacity = capacity_for(ends[-1]) if count else 0
    kind = torch.int16 if tiles < torch.iinfo(torch.int16).max else torch.int32
    keys, ids = torch.full((capacity,), tiles, dtype=kind, device=means.device), radii.new_empty(capacity)
    if count:
        _list[blocks](*seen, counts, nearest, ends, keys, ids, capacity, count, each, *size, BLOCK)
    keys, order = torch.sort(keys, stable=True)
    each_tile = torch.arange(tiles + 1, dtype=kind, device=means.device)
    offsets = torch.searchsorted(keys, each_tile, out_int32=True)
    return TileLists(ids, order, offsets, (cameras, down, across))


@triton.jit
@no_type_check
def _ellipse(means, conics, opacities, radii, i, valid):
    """Centres and conics of Gaussians, the largest quadratic form within their ellipses, the largest radii in pixels,
    and the mask of those in view."""
    wide = tl.load(radii + 2 * i, mask=valid, other=0).to(tl.float32)
    high = tl.load(radii + 2 * i + 1, mask=valid, other=0).to(tl.float32)
    valid &= (wide > 0.0) & (high > 0.0)
    x, y = tl.load(means + 2 * i, mask=valid, other=0.0), tl.load(means + 2 * i + 1, mask=valid, other=0.0)
    a = tl.load(conics + 3 * i, mask=valid, other=1.0)
    b = tl.load(conics + 3 * i + 1, mask=valid, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=valid, other=1.0)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    valid &= opacity > MIN_ALPHA
    reach = 2.0 * tl.log(tl.where(valid, opacity, 1.0) / MIN_ALPHA)
    return x, y, a, b, c, reach, wide, high, valid


@triton.jit
@no_type_check
def _determinant(a, b, c):
    """The determinant of conics, positive: rounding can leave a negative one for long and thin Gaussians."""
    return tl.maximum(a * c - b * b, 1e-20)


@triton.jit
@no_type_check
def _first(edge):
    """The first pixel whose centre is at or after a coordinate."""
    return tl.ceil(edge - 0.5).to(tl.int32)


@triton.jit
@no_type_check
def _last(edge):
    """The last pixel whose centre is at or before a coordinate."""
    return tl.floor(edge - 0.5).to(tl.int32)


@triton.jit
@no_type_check
def _rows(y, a, b, c, reach, high, valid, height):
    """The first row of tiles that Gaussians reach, and the number of such rows."""
    tall = tl.minimum(tl.sqrt(reach * a / _determinant(a, b, c)), high) + SLACK
    top, bottom = tl.maximum(_first(y - tall), 0), tl.minimum(_last(y + tall), height - 1)
    return top // TILE, tl.where(valid & (top <= bottom), bottom // TILE - top // TILE + 1, 0)


@triton.jit
@no_type_check
def _columns(row, x, y, a, b, c, reach, wide, high, valid, width):
    """The first tile of a row that Gaussians reach, and the number of such tiles: between the leftmost and rightmost
    points of the ellipse within the tiles' rows of pixels."""
    det = _determinant(a, b, c)
    tall = tl.minimum(tl.sqrt(reach * a / det), high)
    top = tl.maximum((row * TILE).to(tl.float32) + 0.5 - y - SLACK, -tall)
    bottom = tl.minimum((row * TILE + TILE - 1).to(tl.float32) + 0.5 - y + SLACK, tall)
    tilt = b * tl.sqrt(reach / (c * det))  # height of the leftmost point; that of the rightmost is -tilt
    at_right, at_left = tl.maximum(tl.minimum(-tilt, bottom), top), tl.maximum(tl.minimum(tilt, bottom), top)
    right = (tl.sqrt(tl.maximum(a * reach - det * at_right * at_right, 0.0)) - b * at_right) / a + SLACK
    left = (-tl.sqrt(tl.maximum(a * reach - det * at_left * at_left, 0.0)) - b * at_left) / a - SLACK
    left, right = tl.maximum(left, -wide), tl.minimum(right, wide)
    start, end = tl.maximum(_first(x + left), 0), tl.minimum(_last(x + right), width - 1)
    shown = valid & (top <= bottom) & (start <= end)
    return start // TILE, tl.where(shown, end // TILE - start // TILE + 1, 0)


@triton.jit(do_not_specialize=["count", "width", "height"])
@no_type_check
def _count_tiles(means, conics, opacities, radii, depths, counts, nearness, count, width, height, BLOCK: tl.constexpr):
    """The number of tiles that each Gaussian reaches, and its sort key: its depth, or infinity for none."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, a, b, c, reach, wide, high, valid = _ellipse(means, conics, opacities, radii, i, i < count)
    first, rows = _rows(y, a, b, c, reach, high, valid, height)
    found = tl.zeros((BLOCK,), tl.int32)
    for step in range(tl.max(rows, 0)):
        found += _columns(first + step, x, y, a, b, c, reach, wide, high, step < rows, width)[1]
    tl.store(counts + i, found, mask=i < count)
    depth = tl.load(depths + i, mask=found > 0, other=float("inf"))
    tl.store(nearness + i, depth, mask=i < count)


@triton.jit(do_not_specialize=["capacity", "count", "each", "width", "height", "across", "per_camera"])
@no_type_check
def _list(
    means, conics, opacities, radii, counts, nearest, ends, keys, ids, capacity, count, each, width, height, across,
    per_camera, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the Gaussians, from the nearest to the farthest, to the entries of all tiles that they reach."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(nearest + place, mask=place < count, other=0)
    valid = place < count
    valid &= tl.load(counts + i, mask=valid, other=0) > 0
    end = tl.load(ends + place, mask=valid, other=0)
    free = end - tl.load(counts + i, mask=valid, other=0)
    x, y, a, b, c, reach, wide, high, valid = _ellipse(means, conics, opacities, radii, i, valid)
    first, rows = _rows(y, a, b, c, reach, high, valid, height)
    camera = (i // each).to(tl.int32) * per_camera
    for step in range(tl.max(rows, 0)):
        start, columns = _columns(first + step, x, y, a, b, c, reach, wide, high, step < rows, width)
        tile = camera + (first + step) * across + start
        for column in range(tl.max(columns, 0)):
            fits = (column < columns) & (free + column < tl.minimum(end, capacity))
            tl.store(keys + free + column, tile + column, mask=fits)
            tl.store(ids + free + column, i.to(tl.int32), mask=fits)
        free += columns
