"""Lists of the Gaussians that reach each tile of a LiDAR scan, front to back.

A tile lists a Gaussian where the ellipse alpha = 1/255 meets the row of tiles within the azimuths of the tile, or next
to them by less than a bin of `TileTable`: compositing decides by ray. The determinant of a conic is that of its first
entry and the variance of elevation, which the radius tells: as the difference of products it would cancel for needles.
"""

import math
from typing import NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from drivesplat.kernels.scan_borders import BINS, TileTable
from drivesplat.kernels.scanned_gaussians import MIN_ALPHA, ScannedGaussians
from drivesplat.kernels.triton.tiles import TileLists
from drivesplat.kernels.triton.vectors import around

BLOCK = 128
"""Gaussians per program."""
FAINTEST = tl.constexpr(MIN_ALPHA)
SLACK = tl.constexpr(1e-5)
"""Margin of ellipses in radians, larger than rounding errors of azimuths."""
MARGIN = tl.constexpr(1.001)
"""Factor of radii, larger than rounding errors."""
PER_RADIAN, WHOLE = tl.constexpr(BINS / (2.0 * math.pi)), tl.constexpr(math.pi)
LAST_BIN = tl.constexpr(BINS - 1)


class CountedTiles(NamedTuple):
    """The number of tiles that each of n Gaussians reaches, n being at least 1; and how many of the Gaussians up to and
    with each reach a tile."""

    counts: Int[Tensor, " n"]
    places: Int[Tensor, " n"]

    @property
    def needed(self) -> tuple[Int[Tensor, ""], Int[Tensor, ""]]:
        """The number of Gaussians that reach tiles, and of entries of lists."""
        return self.places[-1], self.counts.sum(dtype=torch.int32)


class ReachedTiles(NamedTuple):
    """r Gaussians from the nearest to the farthest, the numbers of tiles that they reach, and the sums of these
    `counts` so far. The last ones may reach none."""

    nearest: Int[Tensor, " r"]
    counts: Int[Tensor, " r"]
    ends: Int[Tensor, " r"]


@torch.no_grad()
def count_tiles(gaussians: ScannedGaussians, table: TileTable) -> CountedTiles:
    """Counts the tiles that at least one Gaussian reaches."""
    count, (rows, columns) = len(gaussians.ranges), table.tiles.shape
    counts = torch.empty(count, dtype=torch.int32, device=gaussians.ranges.device)
    _count_tiles[(triton.cdiv(count, BLOCK),)](
        *_seen(gaussians), *_arcs(table), counts, count, rows, columns, rows.bit_length(), BINS, BLOCK
    )
    return CountedTiles(counts, torch.cumsum(counts > 0, dim=0, dtype=torch.int32))


@torch.no_grad()
def reached_tiles(gaussians: ScannedGaussians, counted: CountedTiles, capacity: int) -> ReachedTiles:
    """The Gaussians that reach tiles, sorted. Most reach none, and need not be sorted: they are left out first. Where
    `capacity` is too small for the others, the last of their rows are left out, whatever their ranges."""
    counts, places = counted
    ids, reached = (torch.zeros(capacity, dtype=torch.int32, device=counts.device) for _ in range(2))
    nearness = gaussians.ranges.new_full((capacity,), torch.inf)
    _compact[(triton.cdiv(len(counts), BLOCK),)](
        gaussians.ranges.contiguous(), counts, places, nearness, ids, reached, len(counts), capacity, BLOCK
    )
    order = torch.argsort(nearness, stable=True)
    reached = reached[order]
    return ReachedTiles(ids[order], reached, torch.cumsum(reached, dim=0, dtype=torch.int32))


@torch.no_grad()
def scan_lists(gaussians: ScannedGaussians, table: TileTable, reached: ReachedTiles | None, capacity: int) -> TileLists:
    """The lists of all tiles of a scan: those of a row by ascending azimuth, row after row, as one camera. Where
    `capacity`, the number of their entries, is too small, the farthest of the Gaussians that `reached` holds are left
    out. None: no Gaussian."""
    (rows, columns), device = table.tiles.shape, gaussians.ranges.device
    tiles = rows * columns
    kind = torch.int16 if tiles < torch.iinfo(torch.int16).max else torch.int32
    keys = torch.full((capacity,), tiles, dtype=kind, device=device)
    ids = torch.empty(capacity, dtype=torch.int32, device=device)
    if reached is not None and len(reached.nearest):
        count = len(reached.nearest)
        _list[(triton.cdiv(count, BLOCK),)](
            *_seen(gaussians), *_arcs(table), *reached, keys, ids, capacity, count, rows, columns, rows.bit_length(),
            BINS, BLOCK,
        )  # fmt: skip
    keys, order = torch.sort(keys, stable=True)
    each_tile = torch.arange(tiles + 1, dtype=kind, device=device)
    return TileLists(ids, order, torch.searchsorted(keys, each_tile, out_int32=True), (1, rows, columns))


def _seen(gaussians: ScannedGaussians) -> tuple[Tensor, ...]:
    tensors = gaussians.means2d, gaussians.conics, gaussians.radii, gaussians.opacities
    return tuple(tensor.contiguous() for tensor in tensors)


def _arcs(table: TileTable) -> tuple[Tensor, ...]:
    return table.first, table.last, table.lows, table.highs


@triton.jit
@no_type_check
def _ellipse(means2d, conics, radii, opacities, i, valid):
    """Centres, first two entries of conics, determinants, the quadratic forms at the edges, radii, and the mask of
    those that are drawn."""
    wide = tl.load(radii + 2 * i, mask=valid, other=0.0)
    high = tl.load(radii + 2 * i + 1, mask=valid, other=0.0)
    opacity = tl.load(opacities + i, mask=valid, other=0.0)
    valid &= (wide > 0.0) & (high > 0.0) & (opacity >= FAINTEST)
    x = tl.load(means2d + 2 * i, mask=valid, other=0.0)
    y = tl.load(means2d + 2 * i + 1, mask=valid, other=0.0)
    a = tl.load(conics + 3 * i, mask=valid, other=1.0)
    b = tl.load(conics + 3 * i + 1, mask=valid, other=0.0)
    c = tl.load(conics + 3 * i + 2, mask=valid, other=1.0)
    reach = 2.0 * tl.log(tl.where(valid, opacity, 1.0) / FAINTEST)
    safe = tl.where(valid, high, 1.0)
    determinant = a * reach / (safe * safe)
    return x, y, a, b, c, determinant, reach + 1e-3, wide * MARGIN, high * MARGIN, valid


@triton.jit
@no_type_check
def _rows(y, high, valid, lows, highs, rows, steps):
    """The first row that Gaussians reach by their elevation, and the number of such rows: by binary searches."""
    first, first_end = tl.zeros_like(y).to(tl.int32), tl.zeros_like(y).to(tl.int32) + rows
    end, end_end = first, first_end
    for _ in range(steps):
        middle = (first + first_end) // 2
        is_below = (first < first_end) & (tl.load(highs + middle, mask=middle < rows, other=0.0) + SLACK < y - high)
        first, first_end = tl.where(is_below, middle + 1, first), tl.where(is_below, first_end, middle)
        middle = (end + end_end) // 2
        reached = (end < end_end) & (tl.load(lows + middle, mask=middle < rows, other=0.0) - SLACK <= y + high)
        end, end_end = tl.where(reached, middle + 1, end), tl.where(reached, end_end, middle)
    return first, tl.where(valid, end - first, 0)


@triton.jit
@no_type_check
def _reached(
    row, x, y, a, b, c, determinant, reach, wide, high, valid, first, last, lows, highs, columns, BINS: tl.constexpr
):
    """The place of the first column that Gaussians reach in their `row`, and the number of such columns."""
    low = tl.load(lows + row, mask=valid, other=0.0) - SLACK - y
    top = tl.load(highs + row, mask=valid, other=0.0) + SLACK - y
    low, top = tl.maximum(low, -high), tl.minimum(top, high)
    valid &= low <= top
    shown = valid & (determinant > 0.0) & (a > 0.0) & (c > 0.0)
    safe_a, safe_c = tl.where(shown, a, 1.0), tl.where(shown, c, 1.0)
    safe = tl.where(shown, determinant, 1.0)
    tilt = b * tl.sqrt(reach / (safe_c * safe))  # elevation of the leftmost point; that of the rightmost is -tilt
    at_right, at_left = tl.maximum(tl.minimum(-tilt, top), low), tl.maximum(tl.minimum(tilt, top), low)
    right = (tl.sqrt(tl.maximum(a * reach - safe * at_right * at_right, 0.0)) - b * at_right) / safe_a + SLACK
    left = (-tl.sqrt(tl.maximum(a * reach - safe * at_left * at_left, 0.0)) - b * at_left) / safe_a - SLACK
    bound = tl.minimum(wide, WHOLE) + SLACK
    left, right = tl.where(shown, tl.maximum(left, -bound), -bound), tl.where(shown, tl.minimum(right, bound), bound)
    valid &= left <= right
    begin, end = around(x + left), around(x + left) + (right - left)
    turns = tl.where(end >= WHOLE, 1, 0)
    end -= 2.0 * WHOLE * turns.to(tl.float32)
    from_bin = tl.minimum(tl.maximum(((begin + WHOLE) * PER_RADIAN).to(tl.int32), 0), LAST_BIN)
    to_bin = tl.minimum(tl.maximum(((end + WHOLE) * PER_RADIAN).to(tl.int32), 0), LAST_BIN)
    start = tl.load(first + row * BINS + from_bin, mask=valid, other=0)
    stop = tl.load(last + row * BINS + to_bin, mask=valid, other=-1) + columns * turns
    found = tl.minimum(tl.maximum(stop - start + 1, 0), columns)
    found = tl.where(right - left >= 2.0 * WHOLE - 4.0 * SLACK, columns, found)
    return start, tl.where(valid, found, 0)


@triton.jit(do_not_specialize=["count", "rows", "columns", "steps"])
@no_type_check
def _count_tiles(
    means2d, conics, radii, opacities, first, last, lows, highs, counts, count, rows, columns, steps,
    BINS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The number of tiles that each Gaussian reaches."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y, a, b, c, determinant, reach, wide, high, valid = _ellipse(means2d, conics, radii, opacities, i, i < count)
    row, reached = _rows(y, high, valid, lows, highs, rows, steps)
    found = tl.zeros((BLOCK,), tl.int32)
    for step in range(tl.max(reached, 0)):
        valid = step < reached
        found += _reached(
            row + step, x, y, a, b, c, determinant, reach, wide, high, valid, first, last, lows, highs, columns, BINS
        )[1]
    tl.store(counts + i, found, mask=i < count)


@triton.jit(do_not_specialize=["count", "capacity"])
@no_type_check
def _compact(ranges, counts, places, nearness, ids, reached, count, capacity, BLOCK: tl.constexpr):
    """Writes the ranges, numbers and counts of Gaussians that reach tiles, in their order."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tiles = tl.load(counts + i, mask=i < count, other=0)
    place = tl.load(places + i, mask=i < count, other=0) - 1
    kept = (tiles > 0) & (place < capacity)
    tl.store(nearness + place, tl.load(ranges + i, mask=kept, other=0.0), mask=kept)
    tl.store(ids + place, i, mask=kept)
    tl.store(reached + place, tiles, mask=kept)


@triton.jit(do_not_specialize=["capacity", "count", "rows", "columns", "steps"])
@no_type_check
def _list(
    means2d, conics, radii, opacities, first, last, lows, highs, nearest, counts, ends, keys, ids, capacity, count,
    rows, columns, steps, BINS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the Gaussians, from the nearest to the farthest, to the entries of all tiles that they reach."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    i = tl.load(nearest + place, mask=place < count, other=0)
    tiles = tl.load(counts + place, mask=place < count, other=0)
    end = tl.load(ends + place, mask=place < count, other=0)
    free, end = end - tiles, tl.minimum(end, capacity)
    x, y, a, b, c, determinant, reach, wide, high, valid = _ellipse(means2d, conics, radii, opacities, i, tiles > 0)
    row, reached = _rows(y, high, valid, lows, highs, rows, steps)
    for step in range(tl.max(reached, 0)):
        valid = step < reached
        start, found = _reached(
            row + step, x, y, a, b, c, determinant, reach, wide, high, valid, first, last, lows, highs, columns, BINS
        )
        for ahead in range(tl.max(found, 0)):
            column = (start + ahead + columns) % columns
            fits = (ahead < found) & (free + ahead < end)
            tl.store(keys + free + ahead, (row + step) * columns + column, mask=fits)
            tl.store(ids + free + ahead, i, mask=fits)
        free += found
