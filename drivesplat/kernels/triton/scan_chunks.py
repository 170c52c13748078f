"""The lists of a LiDAR scan's tiles cut into chunks, with a copy of each entry's Gaussian, and what it does to rays.

The copies of an entry lie where the list has the entry, field after field: a group of entries is read at once.
"""

from typing import NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import scan_chunks
from drivesplat.kernels.scan_borders import ON_GPU
from drivesplat.kernels.scanned_gaussians import MIN_ALPHA, ScannedGaussians
from drivesplat.kernels.triton.chunks import count_chunks, tile_of
from drivesplat.kernels.triton.tiles import TileLists
from drivesplat.kernels.triton.vectors import around

LENGTH = tl.constexpr(256)
"""Maximum number of entries of a chunk."""
BLOCK, TILES = 256, 4096
"""Entries that a program copies; tiles counted at a time."""
BEAMS, FIRINGS = tl.constexpr(ON_GPU.beams), tl.constexpr(ON_GPU.firings)
RAYS = tl.constexpr(scan_chunks.RAYS)
FAINTEST = tl.constexpr(MIN_ALPHA)
AZIMUTH, ELEVATION, CONIC_AA, CONIC_AE, CONIC_EE, OPACITY, RANGE, SLOPE_A, SLOPE_E, LIMIT, VALUES = (
    tl.constexpr(field) for field in range(11)
)
"""Fields of an entry; its values are the last ones."""
MAX_ALPHA, MIN_TRANSMITTANCE = tl.constexpr(scan_chunks.MAX_ALPHA), tl.constexpr(scan_chunks.MIN_TRANSMITTANCE)
NOTHING = tl.constexpr(scan_chunks.NOTHING)
SUMS = tl.constexpr(3)
"""Sums of a ray that those of the values follow: of ranges, of alpha, and of alpha before `until`."""
SIZES = ["capacity", "tiles", "steps", "beams", "firings", "across"]
"""Arguments of kernels that change from scan to scan: they are not compiled for each value."""


class ScanEntries(NamedTuple):
    """At most `count` chunks of p entries, in the order of t `tiles`: the fields of each entry, the Gaussians `ids`,
    the first entry of each tile, and its first chunk. Entries beyond the last offset are undefined."""

    entries: Float[Tensor, "fields p"]
    ids: Int[Tensor, " p"]
    offsets: Int[Tensor, " t1"]
    firsts: Int[Tensor, " t1"]

    @property
    def tiles(self) -> int:
        return len(self.offsets) - 1

    @property
    def count(self) -> int:
        return self.tiles + len(self.ids) // LENGTH.value

    @property
    def sizes(self) -> tuple[int, int, int]:
        """The numbers of entries and tiles, and the steps of a binary search in tiles, as `chunk_of` takes them."""
        return len(self.ids), self.tiles, self.tiles.bit_length()


def chunks_of(gaussians: ScannedGaussians, values: Float[Tensor, "n v"], lists: TileLists) -> ScanEntries:
    """The chunks of the lists of a scan's tiles."""
    capacity, tiles, channels = len(lists.ids), len(lists.offsets) - 1, values.shape[1]
    entries = values.new_empty(VALUES.value + channels, capacity)
    ids, firsts = torch.empty_like(lists.ids), torch.empty_like(lists.offsets)
    count_chunks[(1,)](lists.offsets, firsts, tiles, LENGTH.value, TILES)
    if capacity:
        means2d, ranges, conics, slopes, limits, _, opacities = (tensor.contiguous() for tensor in gaussians)
        _copy[(triton.cdiv(capacity, BLOCK),)](
            means2d, ranges, conics, slopes, limits, opacities, values.contiguous(), *lists[:3], entries, ids,
            capacity, tiles, channels, BLOCK,
        )  # fmt: skip
    return ScanEntries(entries, ids, lists.offsets, firsts)


@triton.jit
@no_type_check
def _copy_field(entries, field, capacity, place, source, exists):
    tl.store(entries + field * capacity + place, tl.load(source, mask=exists, other=0.0), mask=exists)


@triton.jit(do_not_specialize=["capacity", "tiles"])
@no_type_check
def _copy(
    means2d, ranges, conics, slopes, limits, opacities, values, ids, order, offsets, entries, sorted_ids, capacity,
    tiles, CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    exists = place < tl.load(offsets + tiles)
    i = tl.load(ids + tl.load(order + place, mask=exists, other=0), mask=exists, other=0)
    tl.store(sorted_ids + place, i, mask=exists)
    i = i.to(tl.int64)
    for k in tl.static_range(2):
        _copy_field(entries, AZIMUTH + k, capacity, place, means2d + 2 * i + k, exists)
        _copy_field(entries, SLOPE_A + k, capacity, place, slopes + 2 * i + k, exists)
    for k in tl.static_range(3):
        _copy_field(entries, CONIC_AA + k, capacity, place, conics + 3 * i + k, exists)
    _copy_field(entries, OPACITY, capacity, place, opacities + i, exists)
    _copy_field(entries, RANGE, capacity, place, ranges + i, exists)
    _copy_field(entries, LIMIT, capacity, place, limits + i, exists)
    for k in tl.static_range(CHANNELS):
        _copy_field(entries, VALUES + k, capacity, place, values + CHANNELS * i + k, exists)


@triton.jit
@no_type_check
def chunk_of(chunk, offsets, firsts, tiles, steps):
    """The tile of a chunk, or -1, and the first entry of the chunk and the one after its last."""
    low = tile_of(chunk, firsts, tiles, steps)
    start = tl.load(offsets + low) + (chunk - tl.load(firsts + low)) * LENGTH
    end = tl.minimum(start + LENGTH, tl.load(offsets + low + 1))
    return tl.where(chunk < tl.load(firsts + tiles), low, -1), start, end


@triton.jit
@no_type_check
def rays_of(tile, numbers, beams, firings, across):
    """The indices of a tile's rays, and which of them are in the scan."""
    ray, number = tl.arange(0, RAYS), tl.load(numbers + tile)
    beam, firing = number // across * BEAMS + ray // FIRINGS, number % across * FIRINGS + ray % FIRINGS
    return beam * firings + firing, (beam < beams) & (firing < firings)


@triton.jit
@no_type_check
def field_of(entries, field, capacity, place, end):
    """A field of some entries, as a column; 0 beyond the end of their chunk."""
    return tl.load(entries + field * capacity.to(tl.int64) + place, mask=place < end, other=0.0)[:, None]


@triton.jit
@no_type_check
def offsets_on_rays(entries, capacity, place, end, azimuth, elevation):
    """Azimuths and elevations of rays (a row) from the centres of some entries (a column)."""
    da = around(azimuth - field_of(entries, AZIMUTH, capacity, place, end))
    return da, elevation - field_of(entries, ELEVATION, capacity, place, end)


@triton.jit
@no_type_check
def alpha_on_rays(entries, capacity, place, end, da, de):
    """Alpha of some entries on rays, before it is limited to 0.999; 0 below 1/255."""
    a, b = field_of(entries, CONIC_AA, capacity, place, end), field_of(entries, CONIC_AE, capacity, place, end)
    c, opacity = field_of(entries, CONIC_EE, capacity, place, end), field_of(entries, OPACITY, capacity, place, end)
    exponent = -(0.5 * a * da + b * de) * da - 0.5 * c * de * de
    alpha = opacity * tl.exp(tl.minimum(exponent, 0.0))
    return tl.where((exponent <= 0.0) & (alpha >= FAINTEST), alpha, 0.0)


@triton.jit
@no_type_check
def ranges_on_rays(entries, capacity, place, end, da, de):
    """Ranges at which rays meet some entries, and whether they are not limited."""
    slope_a, slope_e = (
        field_of(entries, SLOPE_A, capacity, place, end),
        field_of(entries, SLOPE_E, capacity, place, end),
    )
    correction, limit = slope_a * da + slope_e * de, field_of(entries, LIMIT, capacity, place, end)
    limited = tl.maximum(tl.minimum(correction, limit), -limit)
    return field_of(entries, RANGE, capacity, place, end) + limited, tl.abs(correction) <= limit
