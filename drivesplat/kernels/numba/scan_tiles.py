"""Lists of the Gaussians that reach each tile of a LiDAR scan, front to back.

A tile lists a Gaussian where the ellipse alpha = 1/255 meets the row of tiles within the azimuths of the tile: it is
drawn nowhere else. The lists are made window by window: consecutive tiles with at most `MAX_ENTRIES` entries together,
or a single tile. Arithmetic is in float64 whatever the tensors are.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import no_type_check

import numpy as np

from drivesplat.kernels.cache import callee, kernel
from drivesplat.kernels.numba.layout import MIN_ALPHA, NumbaTileLists
from drivesplat.kernels.numba.threads import parallel_for
from drivesplat.kernels.scan_borders import ON_CPU, ScanBorders

BEAMS, FIRINGS = ON_CPU
MAX_ENTRIES = 4_000_000
"""Maximum number of entries in a window: 32 MB of lists; the backward pass adds 48 bytes per entry for two float32
values."""
CHUNK = 4096
"""Gaussians per chunk."""
RADIUS_MARGIN = 1.001
"""Factor of radii, larger than any rounding error."""
SLACK = 4e-6
"""Margin of ellipses in radians, larger than any float32 rounding error of an azimuth."""
AZIMUTH, ELEVATION, CONIC_AA, CONIC_AE, CONIC_EE, OPACITY, REACH, RADIUS_A, RADIUS_E = range(9)
RANGE, SLOPE_A, SLOPE_E, RANGE_LIMIT = range(9, 13)
"""Columns of `ScanSplats.shapes`. A Gaussian is drawn where its exponent's quadratic form is at most REACH."""


@dataclass(frozen=True)
class ScanSplats:
    """The m Gaussians that can be drawn, by ascending range.

    `order` (m,) are their numbers in the scene; `shapes` (m, 13), with the columns numbered above, and `values`
    (m, channels) are drawn.
    """

    order: np.ndarray
    shapes: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Arcs:
    """The azimuths and elevations of tiles, as kernels take them; see ScanBorders."""

    centers: np.ndarray
    half_widths: np.ndarray
    order: np.ndarray
    lows: np.ndarray
    highs: np.ndarray

    @classmethod
    def of(cls, borders: ScanBorders) -> "Arcs":
        return cls(*(tensor.contiguous().numpy() for tensor in borders[:5]))

    @property
    def tiles(self) -> int:
        return self.centers.size

    def may_reach(self, azimuths: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Whether intervals around azimuths (n,) may meet rays at all: (n,) bool. Half a revolution has none behind."""
        middle = self.centers.flat[self.centers.size // 2]
        off = wrapped(self.centers - middle)
        low, high = (off - self.half_widths).min() - SLACK, (off + self.half_widths).max() + SLACK
        away = np.abs(wrapped(azimuths - (middle + 0.5 * (low + high))))
        return away <= 0.5 * (high - low) + radii

    @property
    def arguments(self) -> tuple[np.ndarray, ...]:
        return self.centers, self.half_widths, self.half_widths.max(axis=1), self.order, self.lows, self.highs


def by_range(
    means2d: np.ndarray, ranges: np.ndarray, conics: np.ndarray, slopes: np.ndarray, range_limits: np.ndarray,
    radii: np.ndarray, opacities: np.ndarray, values: np.ndarray, arcs: Arcs,
) -> ScanSplats:  # fmt: skip
    """The Gaussians that are not skipped, that some tile may meet and whose opacity is at least 1/255; the order of
    equal ranges is kept."""
    elevations, reach = means2d[:, 1], radii[:, 1] * RADIUS_MARGIN + SLACK
    visible = (radii > 0).all(axis=1) & (opacities >= MIN_ALPHA)
    visible &= (elevations + reach >= arcs.lows.min()) & (elevations - reach <= arcs.highs.max())
    visible = np.flatnonzero(visible)
    visible = visible[arcs.may_reach(means2d[visible, 0], radii[visible, 0] * RADIUS_MARGIN + SLACK)]
    order = visible[np.argsort(ranges[visible], kind="stable")]
    reach = 2.0 * np.log(opacities[order].astype(np.float64) / MIN_ALPHA) + 1e-3
    columns = (means2d, conics, opacities[:, None], radii, ranges[:, None], slopes, range_limits[:, None])
    shapes = np.empty((len(order), RANGE_LIMIT + 1), means2d.dtype)
    at = 0
    for column in columns:
        at += at == REACH
        shapes[:, at : at + column.shape[1]] = column[order]
        at += column.shape[1]
    shapes[:, REACH] = reach
    return ScanSplats(order, shapes, values[order])


def scan_lists(splats: ScanSplats, arcs: Arcs, first: int = 0, last: int | None = None) -> Iterator[NumbaTileLists]:
    """The lists of a scan's tiles, window by window."""
    last = arcs.tiles if last is None else last
    counts = np.zeros(len(splats.order), np.int64)
    parallel_for(_count, len(counts), CHUNK, splats.shapes, *arcs.arguments, first, last, counts)
    if counts.sum() > MAX_ENTRIES and last - first > 1:
        middle = (first + last) // 2
        yield from scan_lists(splats, arcs, first, middle)
        yield from scan_lists(splats, arcs, middle, last)
        return
    slot_offsets = np.concatenate([[0], np.cumsum(counts)])
    small = np.uint16 if last - first <= 2**16 else np.uint32  # numpy sorts 16 bits by radix
    tile_of, rank_of = np.empty(slot_offsets[-1], small), np.empty(slot_offsets[-1], np.int32)
    parallel_for(_fill, len(counts), CHUNK, splats.shapes, *arcs.arguments, first, last, slot_offsets, tile_of, rank_of)
    slots = np.argsort(tile_of, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(tile_of, minlength=last - first))])
    yield NumbaTileLists(first, last, offsets, rank_of[slots], slots.astype(np.int32), slot_offsets)


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Angles in radians within ±π."""
    return angles - 2.0 * np.pi * np.round(angles / (2.0 * np.pi))


@callee
@no_type_check
def wrap(angle):
    """An angle between -2π and 2π, within ±π."""
    if angle > math.pi:
        return angle - 2.0 * math.pi
    if angle < -math.pi:
        return angle + 2.0 * math.pi
    return angle


@callee
@no_type_check
def span(a, b, c, reach, low, high, bound):
    """The range of u in which a u² + 2 b u v + c v² <= reach for some v in [low, high], within ±bound.

    The end of an empty range is below its start.
    """
    bound += SLACK
    low, high = low - SLACK, high + SLACK
    determinant = a * c - b * b
    if not (determinant > 0.0 and a > 0.0 and c > 0.0):  # no ellipse, after rounding
        return -bound, bound
    v_max = math.sqrt(reach * a / determinant)
    low, high = max(low, -v_max), min(high, v_max)
    if low > high:
        return 1.0, -1.0
    turn = b * math.sqrt(reach * c / determinant) / c
    v = min(max(-turn, low), high)
    right = (math.sqrt(max(a * reach - determinant * v * v, 0.0)) - b * v) / a
    v = min(max(turn, low), high)
    left = (-math.sqrt(max(a * reach - determinant * v * v, 0.0)) - b * v) / a
    return max(left - SLACK, -bound), min(right + SLACK, bound)


@callee
@no_type_check
def _arc(shape, low, high):
    """Middle and half width of the azimuths that a Gaussian reaches between two elevations; half width -1: none."""
    elevation, radius = float(shape[ELEVATION]), float(shape[RADIUS_E]) * RADIUS_MARGIN + SLACK
    if elevation + radius < low or elevation - radius > high:
        return 0.0, -1.0
    left, right = span(
        float(shape[CONIC_AA]), float(shape[CONIC_AE]), float(shape[CONIC_EE]), float(shape[REACH]),
        low - elevation, high - elevation, min(float(shape[RADIUS_A]) * RADIUS_MARGIN, math.pi),
    )  # fmt: skip
    if left > right:
        return 0.0, -1.0
    return wrap(float(shape[AZIMUTH]) + 0.5 * (left + right)), 0.5 * (right - left)


@callee
@no_type_check
def _first_from(centers, order, azimuth):
    """The first place in `order` whose centre is not below an azimuth."""
    low, high = 0, len(order)
    while low < high:
        middle = (low + high) // 2
        if centers[order[middle]] < azimuth:
            low = middle + 1
        else:
            high = middle
    return low


@callee
@no_type_check
def _list_row(shape, row, centers, half_widths, widest, order, lows, highs, first, last, tiles, slot):
    """Writes the tiles of a row that a Gaussian reaches to `tiles` from `slot`, if that has places; their number."""
    middle, half = _arc(shape, lows[row], highs[row])
    if half < 0.0:
        return 0
    columns, found, reach = centers.shape[1], 0, half + widest[row] + SLACK
    around = reach >= math.pi  # the Gaussian may reach all columns
    begin = wrap(middle - min(reach, math.pi))
    start = 0 if around else _first_from(centers[row], order[row], begin)
    for i in range(columns):
        column = order[row, (start + i) % columns]
        center = centers[row, column]
        if abs(wrap(center - middle)) <= half + half_widths[row, column] + SLACK:
            tile = row * columns + column
            if first <= tile < last:
                if len(tiles):
                    tiles[slot + found] = tile - first
                found += 1
        elif not around:
            ahead = center - begin
            if (ahead if ahead >= 0.0 else ahead + 2.0 * math.pi) > 2.0 * reach:
                break
    return found


@kernel
@no_type_check
def _count(start, stop, shapes, centers, half_widths, widest, order, lows, highs, first, last, counts):
    columns, nowhere = centers.shape[1], np.empty(0, np.uint16)
    for r in range(start, stop):
        for row in range(first // columns, (last - 1) // columns + 1):
            counts[r] += _list_row(
                shapes[r], row, centers, half_widths, widest, order, lows, highs, first, last, nowhere, 0
            )


@kernel
@no_type_check
def _fill(
    start, stop, shapes, centers, half_widths, widest, order, lows, highs, first, last, slot_offsets, tile_of, rank_of
):
    columns = centers.shape[1]
    for r in range(start, stop):
        slot = slot_offsets[r]
        for row in range(first // columns, (last - 1) // columns + 1):
            slot += _list_row(
                shapes[r], row, centers, half_widths, widest, order, lows, highs, first, last, tile_of, slot
            )
        rank_of[slot_offsets[r] : slot] = r
