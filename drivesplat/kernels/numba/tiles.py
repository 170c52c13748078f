"""Lists of the Gaussians that reach each tile of an image, front to back.

A tile lists a Gaussian where the ellipse alpha = 1/255 meets the rectangle of the tile's pixel centres: it is drawn
nowhere else. An image's lists are made window by window: consecutive tiles with at most `MAX_ENTRIES` entries together,
or a single tile. This bounds the memory for any scene.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.layout import (
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    MEAN_X,
    MEAN_Y,
    MIN_ALPHA,
    RADIUS_X,
    RADIUS_Y,
    REACH,
    SLACK,
    TILE_HEIGHT,
    TILE_WIDTH,
    NumbaTileLists,
)
from drivesplat.kernels.numba.threads import parallel_for

MAX_ENTRIES = 4_000_000
"""Maximum number of entries in a window: 32 MB of lists; the backward pass adds 36 bytes per entry for three float32
channels."""
CHUNKS = 16
"""Chunks in which Gaussians are listed, each with its own count for every tile."""


@dataclass(frozen=True)
class Splats:
    """The m Gaussians in view of one camera, front to back.

    `order` (m,) are their numbers in the scene; `shapes` (m, 9), with the columns that `layout` numbers, and `values`
    (m, channels) are drawn.
    """

    order: np.ndarray
    shapes: np.ndarray
    values: np.ndarray


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)


def front_to_back(
    means2d: np.ndarray,
    depths: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    radii: np.ndarray,
    values: np.ndarray,
) -> Splats:
    """The Gaussians in view whose opacity is at least 1/255; the order of equal depths is kept."""
    visible = np.flatnonzero((radii[:, 0] > 0) & (radii[:, 1] > 0) & (opacities >= MIN_ALPHA)).astype(np.int32)
    keys = depths[visible]
    keys = keys.view(np.uint32 if keys.dtype == np.float32 else np.uint64)  # of positive numbers, in the same order
    order = _sorted_by(visible, keys)
    reach = 2.0 * np.log(opacities[order].astype(np.float64) / MIN_ALPHA) + 1e-3
    by_column = (means2d[order], conics[order], opacities[order, None], reach[:, None], radii[order])
    return Splats(order, np.concatenate(by_column, axis=1, dtype=means2d.dtype, casting="same_kind"), values[order])


def tile_lists(splats: Splats, columns: int, rows: int) -> Iterator[NumbaTileLists]:
    """The lists of an image's tiles, window by window."""
    counts, tiles_of = _count(splats, columns, 0, columns * rows)
    windows = _windows(counts.sum(axis=0))
    for first, last in windows:
        if len(windows) > 1:
            counts, tiles_of = _count(splats, columns, first, last)
        yield _list(splats, columns, first, last, counts, tiles_of)


def _windows(counts: np.ndarray) -> list[tuple[int, int]]:
    """First and last tile (excluded) of consecutive windows with at most MAX_ENTRIES entries, or one tile."""
    windows, first, total = [], 0, 0
    for tile, count in enumerate(counts.tolist()):
        if total + count > MAX_ENTRIES and tile > first:
            windows.append((first, tile))
            first, total = tile, 0
        total += count
    return [*windows, (first, len(counts))]


def _list(
    splats: Splats, columns: int, first: int, last: int, counts: np.ndarray, tiles_of: np.ndarray
) -> NumbaTileLists:
    slot_offsets = np.concatenate([[0], np.cumsum(tiles_of)])
    offsets = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    cursors = np.cumsum(counts, axis=0) - counts + offsets[:-1]  # the first entry of a chunk in a tile
    ranks, slots = np.empty(offsets[-1], np.int32), np.empty(offsets[-1], np.int32)
    chunk = _chunk_size(len(splats.order))
    parallel_for(
        _fill, len(splats.order), chunk, splats.shapes, columns, first, last, chunk, slot_offsets, cursors, ranks, slots
    )
    return NumbaTileLists(first, last, offsets, ranks, slots, slot_offsets)


def _chunk_size(m: int) -> int:
    return max(1, -(-m // CHUNKS))


def _count(splats: Splats, columns: int, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Entries by chunk and tile, and by Gaussian."""
    m = len(splats.order)
    chunk, counts, tiles_of = _chunk_size(m), np.zeros((CHUNKS, last - first), np.int64), np.zeros(m, np.int64)
    parallel_for(_count_chunk, m, chunk, splats.shapes, columns, first, last, chunk, counts, tiles_of)
    return counts, tiles_of


@callee
@no_type_check
def _digit(key, shift):
    return np.int64((np.uint64(key) >> np.uint64(shift)) & np.uint64(2047))


@kernel
@no_type_check
def _sorted_by(items, keys):
    """`items` by ascending `keys`, stable: a radix sort, 11 bits at a time."""
    n = len(items)
    items, other_items, other_keys = items.copy(), np.empty_like(items), np.empty_like(keys)
    keys = keys.copy()
    for shift in range(0, 8 * keys.itemsize, 11):
        starts = np.zeros(2049, np.int64)
        for i in range(n):
            starts[_digit(keys[i], shift) + 1] += 1
        for digit in range(2048):
            starts[digit + 1] += starts[digit]
        for i in range(n):
            digit = _digit(keys[i], shift)
            other_items[starts[digit]] = items[i]
            other_keys[starts[digit]] = keys[i]
            starts[digit] += 1
        items, other_items = other_items, items
        keys, other_keys = other_keys, keys
    return items


@callee
@no_type_check
def _span(a, b, c, reach, low, high, bound):
    """The range of u in which a u² + 2 b u v + c v² <= reach for some v in [low, high], within ±bound.

    The end of an empty range is below its start.
    """
    determinant = a * c - b * b
    if not (determinant > 0.0 and a > 0.0 and c > 0.0):  # no ellipse, after rounding
        return -bound, bound
    v_max = math.sqrt(reach * a / determinant) + SLACK
    low, high = max(low, -v_max), min(high, v_max)
    if low > high:
        return 1.0, -1.0
    u_max = math.sqrt(reach * c / determinant)
    turn = b * u_max / c
    v = min(max(-turn, low), high)
    right = (math.sqrt(max(a * reach - determinant * v * v, 0.0)) - b * v) / a
    v = min(max(turn, low), high)
    left = (-math.sqrt(max(a * reach - determinant * v * v, 0.0)) - b * v) / a
    return max(left - SLACK, -bound), min(right + SLACK, bound)


@callee
@no_type_check
def _tile_rows(shape, columns, first, last):
    """First and last row (excluded) of tiles that a Gaussian may reach."""
    c, determinant = float(shape[CONIC_YY]), float(shape[CONIC_XX]) * shape[CONIC_YY] - float(shape[CONIC_XY]) ** 2
    y, reach = float(shape[MEAN_Y]), float(shape[RADIUS_Y])
    if determinant > 0.0 and c > 0.0:
        reach = min(reach, math.sqrt(shape[REACH] * shape[CONIC_XX] / determinant) + SLACK)
    begin = max(math.floor((y - reach - 0.5) / TILE_HEIGHT), first // columns)
    end = min(math.floor((y + reach - 0.5) / TILE_HEIGHT) + 1, (last - 1) // columns + 1)
    return int(begin), int(end)


@callee
@no_type_check
def _tile_columns(shape, row, columns, first, last):
    """First and last tile (excluded), in the image's numbering, that a Gaussian reaches in a row of tiles."""
    low = row * TILE_HEIGHT + 0.5 - shape[MEAN_Y]
    left, right = _span(
        float(shape[CONIC_XX]), float(shape[CONIC_XY]), float(shape[CONIC_YY]), float(shape[REACH]),
        low, low + TILE_HEIGHT - 1.0, float(shape[RADIUS_X]),
    )  # fmt: skip
    if left > right:
        return 0, 0
    x = float(shape[MEAN_X]) - 0.5
    begin = max(math.ceil((x + left - (TILE_WIDTH - 1)) / TILE_WIDTH), 0)
    end = min(math.floor((x + right) / TILE_WIDTH) + 1, columns)
    return max(int(begin) + row * columns, first), min(int(end) + row * columns, last)


@kernel
@no_type_check
def _count_chunk(start, stop, shapes, columns, first, last, chunk, counts, tiles_of):
    own = counts[start // chunk]
    for r in range(start, stop):
        begin, end = _tile_rows(shapes[r], columns, first, last)
        for row in range(begin, end):
            left, right = _tile_columns(shapes[r], row, columns, first, last)
            for tile in range(left, right):
                own[tile - first] += 1
            tiles_of[r] += max(right - left, 0)


@kernel
@no_type_check
def _fill(start, stop, shapes, columns, first, last, chunk, slot_offsets, cursors, ranks, slots):
    cursor = cursors[start // chunk]
    for r in range(start, stop):
        slot = slot_offsets[r]
        begin, end = _tile_rows(shapes[r], columns, first, last)
        for row in range(begin, end):
            left, right = _tile_columns(shapes[r], row, columns, first, last)
            for tile in range(left, right):
                at = cursor[tile - first]
                cursor[tile - first] = at + 1
                ranks[at] = r
                slots[at] = slot
                slot += 1
