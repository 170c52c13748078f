"""Which Gaussians the tiles of images show, front to back.

A Gaussian is listed where its ellipse, out to where it covers a pixel by less than 1/255, reaches the centres of a
tile's pixels, which is not wherever its bounding box does.
"""

from typing import NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import capacity as rooms

BLOCK = 128
"""Gaussians a program."""
TILE = tl.constexpr(16)
"""Edge of a tile in pixels."""
FAINTEST = tl.constexpr(1.0 / 255.0)
"""What covers a pixel by less is not rasterized, as in 3D Gaussian Splatting."""
SLACK = tl.constexpr(0.01)
"""Pixels by which an ellipse is taken to be wider and taller, against rounding."""


class Projected(NamedTuple):
    """Gaussians as c cameras see them, n each. `conics` are the upper triangles of inverse covariances."""

    means: Float[Tensor, "c n 2"]
    conics: Float[Tensor, "c n 3"]
    values: Float[Tensor, "c n v"]
    opacities: Float[Tensor, "c n"]


class Lists(NamedTuple):
    """What tiles show, by camera, row and column: of those, front to back, `ids[order[offsets[t] : offsets[t + 1]]]`
    are the Gaussians of tile t, counted through all cameras. What `order` holds beyond the last offset means nothing.
    `tiles` is the number of cameras, and of rows and columns of tiles."""

    ids: Int[Tensor, " p"]
    order: Int[Tensor, " p"]
    offsets: Int[Tensor, " t"]
    tiles: tuple[int, int, int]


@torch.no_grad()
def lists_of(
    gaussians: Projected,
    radii: Int[Tensor, "c n 2"],
    depths: Float[Tensor, "c n"],
    width: int,
    height: int,
) -> Lists:
    """The lists of all tiles of c images. `radii` are 0 where a camera does not see a Gaussian, `depths` metres. Where
    `rooms` gives too little room, what is farthest is left out."""
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
    room = rooms.room_for(ends[-1]) if count else 0
    kind = torch.int16 if tiles < torch.iinfo(torch.int16).max else torch.int32
    keys, ids = torch.full((room,), tiles, dtype=kind, device=means.device), radii.new_empty(room)
    if count:
        _list[blocks](*seen, counts, nearest, ends, keys, ids, room, count, each, *size, BLOCK)
    keys, order = torch.sort(keys, stable=True)
    each_tile = torch.arange(tiles + 1, dtype=kind, device=means.device)
    offsets = torch.searchsorted(keys, each_tile, out_int32=True)
    return Lists(ids, order, offsets, (cameras, down, across))


@triton.jit
@no_type_check
def _ellipse(means, conics, opacities, radii, i, there):
    """Centres and conics of Gaussians, how far out they reach, in the conic's measure and at most in pixels, and which
    can be seen."""
    wide = tl.load(radii + 2 * i, mask=there, other=0).to(tl.float32)
    high = tl.load(radii + 2 * i + 1, mask=there, other=0).to(tl.float32)
    there &= (wide > 0.0) & (high > 0.0)
    x, y = tl.load(means + 2 * i, mask=there, other=0.0), tl.load(means + 2 * i + 1, mask=there, other=0.0)
    a = tl.load(conics + 3 * i, mask=there, other=1.0)
    b = tl.load(conics + 3 * i + 1, mask=there, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=there, other=1.0)
    opacity = tl.load(opacities + i, mask=there, other=0.0)
    there &= opacity > FAINTEST
    reach = 2.0 * tl.log(tl.where(there, opacity, 1.0) / FAINTEST)
    return x, y, a, b, c, reach, wide, high, there


@triton.jit
@no_type_check
def _determinant(a, b, c):
    """Of conics; of long and thin ones rounding leaves little, or less than nothing."""
    return tl.maximum(a * c - b * b, 1e-20)


@triton.jit
@no_type_check
def _first(edge):
    """The first pixel whose centre is not before a coordinate."""
    return tl.ceil(edge - 0.5).to(tl.int32)


@triton.jit
@no_type_check
def _last(edge):
    """The last pixel whose centre is not behind a coordinate."""
    return tl.floor(edge - 0.5).to(tl.int32)


@triton.jit
@no_type_check
def _rows(y, a, b, c, reach, high, there, height):
    """The first row of tiles that shows Gaussians, and how many do."""
    tall = tl.minimum(tl.sqrt(reach * a / _determinant(a, b, c)), high) + SLACK
    top, bottom = tl.maximum(_first(y - tall), 0), tl.minimum(_last(y + tall), height - 1)
    return top // TILE, tl.where(there & (top <= bottom), bottom // TILE - top // TILE + 1, 0)


@triton.jit
@no_type_check
def _columns(row, x, y, a, b, c, reach, wide, high, there, width):
    """The first tile of a row that shows Gaussians, and how many do: between the outermost points of the ellipse among
    the rows of pixels of these tiles."""
    det = _determinant(a, b, c)
    tall = tl.minimum(tl.sqrt(reach * a / det), high)
    top = tl.maximum((row * TILE).to(tl.float32) + 0.5 - y - SLACK, -tall)
    bottom = tl.minimum((row * TILE + TILE - 1).to(tl.float32) + 0.5 - y + SLACK, tall)
    tilt = b * tl.sqrt(reach / (c * det))  # of its outermost points, by height
    at_right, at_left = tl.maximum(tl.minimum(-tilt, bottom), top), tl.maximum(tl.minimum(tilt, bottom), top)
    right = (tl.sqrt(tl.maximum(a * reach - det * at_right * at_right, 0.0)) - b * at_right) / a + SLACK
    left = (-tl.sqrt(tl.maximum(a * reach - det * at_left * at_left, 0.0)) - b * at_left) / a - SLACK
    left, right = tl.maximum(left, -wide), tl.minimum(right, wide)
    start, end = tl.maximum(_first(x + left), 0), tl.minimum(_last(x + right), width - 1)
    shown = there & (top <= bottom) & (start <= end)
    return start // TILE, tl.where(shown, end // TILE - start // TILE + 1, 0)


@triton.jit(do_not_specialize=["count", "width", "height"])
@no_type_check
def _count_tiles(means, conics, opacities, radii, depths, counts, nearness, count, width, height, BLOCK: tl.constexpr):
    """How many tiles show each Gaussian, and by what it is sorted: its depth, if any does."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, a, b, c, reach, wide, high, there = _ellipse(means, conics, opacities, radii, i, i < count)
    first, rows = _rows(y, a, b, c, reach, high, there, height)
    found = tl.zeros((BLOCK,), tl.int32)
    for step in range(tl.max(rows, 0)):
        found += _columns(first + step, x, y, a, b, c, reach, wide, high, step < rows, width)[1]
    tl.store(counts + i, found, mask=i < count)
    depth = tl.load(depths + i, mask=found > 0, other=float("inf"))
    tl.store(nearness + i, depth, mask=i < count)


@triton.jit(do_not_specialize=["room", "count", "each", "width", "height", "across", "per_camera"])
@no_type_check
def _list(
    means, conics, opacities, radii, counts, nearest, ends, keys, ids, room, count, each, width, height, across,
    per_camera, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes each Gaussian, from the nearest to the farthest, down for every tile that shows it."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(nearest + place, mask=place < count, other=0)
    there = place < count
    there &= tl.load(counts + i, mask=there, other=0) > 0
    end = tl.load(ends + place, mask=there, other=0)
    free = end - tl.load(counts + i, mask=there, other=0)
    x, y, a, b, c, reach, wide, high, there = _ellipse(means, conics, opacities, radii, i, there)
    first, rows = _rows(y, a, b, c, reach, high, there, height)
    camera = (i // each).to(tl.int32) * per_camera
    for step in range(tl.max(rows, 0)):
        start, columns = _columns(first + step, x, y, a, b, c, reach, wide, high, step < rows, width)
        tile = camera + (first + step) * across + start
        for column in range(tl.max(columns, 0)):
            fits = (column < columns) & (free + column < tl.minimum(end, room))
            tl.store(keys + free + column, tile + column, mask=fits)
            tl.store(ids + free + column, i.to(tl.int32), mask=fits)
        free += columns
