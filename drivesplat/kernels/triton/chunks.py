"""Tiles' lists of Gaussians cut into chunks, which are rasterized in parallel and then composited.

A block of gsplat's rasterizer processes the list of one tile, one Gaussian after the other. On a drive most distant
Gaussians fall into a few tiles, whose lists are tens of times as long as the others': the image waits for them. Each
chunk becomes an image of a tile's size, and these are composited front to back.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.composited import Composited
from drivesplat.kernels.triton.joined_chunks import join
from drivesplat.kernels.triton.pixels import TILE
from drivesplat.kernels.triton.rows import add_nonzero
from drivesplat.kernels.triton.tiles import Footprints, TileLists

LENGTH = 512
"""Maximum number of Gaussians in a chunk."""
MAX_VALUES = 8
"""Maximum number of values of a Gaussian: every entry of a list gets its own copy of them."""
BLOCK = 4096
"""Tiles counted at a time."""
TILES = 128
"""Tiles whose chunks one program names."""

Rasterizer = Callable[..., tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Chunks:
    """The chunks of all lists, at most `count` of at most `length` entries each, tile after tile: the first of each of
    t tiles, then the number of all (`firsts`), and the tile of each (`tile_of`, undefined beyond the last)."""

    firsts: Int[Tensor, " t1"]
    tile_of: Int[Tensor, " m"]
    count: int
    length: int

    @classmethod
    def of(cls, lists: TileLists, length: int) -> "Chunks":
        """Chunks of at most `length` entries."""
        tiles = len(lists.offsets) - 1
        count = tiles + len(lists.ids) // length
        firsts, tile_of = lists.ids.new_empty(tiles + 1), lists.ids.new_empty(count)
        count_chunks[(1,)](lists.offsets, firsts, tiles, length, BLOCK)
        _name_tiles[(triton.cdiv(tiles, TILES),)](firsts, tile_of, tiles, TILES)
        return cls(firsts, tile_of, count, length)


def composite(
    gaussians: Footprints, lists: TileLists, width: int, height: int, rasterizer: Rasterizer, with_depth: bool = False
) -> Composited:
    """Images of values, and alpha, equal to those of gsplat's `rasterize_to_pixels`, which is the `rasterizer`. With
    `with_depth` the last of the values is depth.

    Rays end later than there: in a chunk where their transmittance in the chunk falls below 1e-4, and behind a chunk
    where that of all chunks so far does. Alpha of pixels that opaque Gaussians cover is 1e-4 larger.
    """
    *copies, starts, exists, firsts = _Split.apply(*gaussians, lists)
    edge = TILE.value
    each = torch.arange(len(lists.ids), dtype=torch.int32, device=lists.ids.device)
    values, alpha = rasterizer(*copies, edge, edge, edge, starts, each, masks=exists, packed=True)
    return join(values.flatten(1, 2), alpha.flatten(1), firsts, lists.tiles, width, height, with_depth)


class _Split(torch.autograd.Function):
    """Copies of the Gaussians for every list entry, in coordinates of their tile; where chunks start (m, 1, 1), which
    chunks exist (m, 1, 1), and every tile's first chunk."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, conics: Tensor, values: Tensor, opacities: Tensor, lists: TileLists
    ) -> tuple[Tensor, ...]:
        given = [tensor.contiguous() for tensor in (means, conics, values, opacities)]
        capacity, (cameras, down, across) = len(lists.ids), lists.tiles
        tiles = cameras * down * across
        chunks = tiles + capacity // LENGTH + 1  # a chunk ends where the next one starts: one more than needed
        starts, firsts = lists.ids.new_empty(chunks, 1, 1), lists.ids.new_empty(tiles + 1)
        exists = torch.empty(chunks, 1, 1, dtype=torch.bool, device=means.device)
        copies = [means.new_empty(capacity, width) for width in (2, 3, values.shape[-1])] + [means.new_empty(capacity)]
        count_chunks[(1,)](lists.offsets, firsts, tiles, LENGTH, BLOCK)
        _split[(chunks,)](
            *given, *lists[:3], firsts, *copies, starts, exists,
            tiles, down * across, across, tiles.bit_length(), values.shape[-1], LENGTH,
        )  # fmt: skip
        ctx.save_for_backward(*lists[:3], firsts, starts)
        ctx.shapes = [tensor.shape for tensor in given]
        ctx.mark_non_differentiable(starts, exists, firsts)
        return *copies, starts, exists, firsts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        ids, order, offsets, firsts, starts = ctx.saved_tensors
        copies = [tensor.contiguous() for tensor in gradients[:4]]
        summed = [tensor.new_zeros(shape) for tensor, shape in zip(copies, ctx.shapes, strict=True)]
        tiles = len(offsets) - 1
        _sum_copies[(len(starts),)](
            *copies, ids, order, offsets, firsts, starts, *summed, tiles, ctx.shapes[2][-1], LENGTH
        )
        return *summed, None


@triton.jit(do_not_specialize=["tiles"])
@no_type_check
def count_chunks(offsets, firsts, tiles, LENGTH: tl.constexpr, BLOCK: tl.constexpr):
    """Writes the first chunk of every tile, and after them the number of chunks."""
    found = 0
    for begin in range(0, tiles, BLOCK):
        tile = begin + tl.arange(0, BLOCK)
        inside = tile < tiles
        entries = tl.load(offsets + tile + 1, mask=inside, other=0) - tl.load(offsets + tile, mask=inside, other=0)
        chunks = (entries + LENGTH - 1) // LENGTH
        tl.store(firsts + tile, found + tl.cumsum(chunks, 0) - chunks, mask=inside)
        found += tl.sum(chunks)
    tl.store(firsts + tiles, found)


@triton.jit(do_not_specialize=["tiles"])
@no_type_check
def _name_tiles(firsts, tile_of, tiles, TILES: tl.constexpr):
    """Writes the tile of every chunk."""
    tile = tl.program_id(0) * TILES + tl.arange(0, TILES)
    inside = tile < tiles
    first = tl.load(firsts + tile, mask=inside, other=0)
    chunks = tl.load(firsts + tile + 1, mask=inside, other=0) - first
    for step in range(tl.max(chunks, 0)):
        tl.store(tile_of + first + step, tile, mask=step < chunks)


@triton.jit
@no_type_check
def tile_of(chunk, firsts, tiles, steps):
    """The last tile whose first chunk is not after this one."""
    low, high = 0, tiles
    for _ in range(steps):
        middle = (low + high) // 2
        behind = tl.load(firsts + middle) <= chunk
        low, high = tl.where(behind, middle, low), tl.where(behind, high, middle)
    return low


@triton.jit(do_not_specialize=["tiles", "per_camera", "across", "steps"])
@no_type_check
def _split(
    means, conics, values, opacities, ids, order, offsets, firsts, means_copies, conics_copies, values_copies,
    opacities_copies, starts, exists, tiles, per_camera, across, steps, CHANNELS: tl.constexpr, LENGTH: tl.constexpr,
):  # fmt: skip
    """Copies the Gaussians of a chunk. Chunks beyond the last one are empty and start at the end of all entries."""
    chunk = tl.program_id(0)
    is_one = chunk < tl.load(firsts + tiles)
    low = tile_of(chunk, firsts, tiles, steps)
    start = tl.load(offsets + low) + (chunk - tl.load(firsts + low)) * LENGTH
    start = tl.where(is_one, start, tl.load(offsets + tiles))
    tl.store(starts + chunk, start)
    tl.store(exists + chunk, is_one)
    place = start.to(tl.int64) + tl.arange(0, LENGTH)
    inside = is_one & (place < tl.load(offsets + low + 1))
    i = tl.load(ids + tl.load(order + place, mask=inside, other=0), mask=inside, other=0).to(tl.int64)
    left, top = (low % per_camera) % across * TILE, (low % per_camera) // across * TILE
    tl.store(means_copies + 2 * place, tl.load(means + 2 * i, mask=inside, other=0.0) - left, mask=inside)
    tl.store(means_copies + 2 * place + 1, tl.load(means + 2 * i + 1, mask=inside, other=0.0) - top, mask=inside)
    for k in tl.static_range(3):
        tl.store(conics_copies + 3 * place + k, tl.load(conics + 3 * i + k, mask=inside, other=0.0), mask=inside)
    for k in tl.static_range(CHANNELS):
        value = tl.load(values + CHANNELS * i + k, mask=inside, other=0.0)
        tl.store(values_copies + CHANNELS * place + k, value, mask=inside)
    tl.store(opacities_copies + place, tl.load(opacities + i, mask=inside, other=0.0), mask=inside)


@triton.jit(do_not_specialize=["tiles"])
@no_type_check
def _sum_copies(
    v_means_copies, v_conics_copies, v_values_copies, v_opacities_copies, ids, order, offsets, firsts, starts, v_means,
    v_conics, v_values, v_opacities, tiles, CHANNELS: tl.constexpr, LENGTH: tl.constexpr,
):  # fmt: skip
    """Adds the gradients of a chunk's copies to those of their Gaussians."""
    chunk = tl.program_id(0)
    is_one = chunk < tl.load(firsts + tiles)
    place = tl.load(starts + chunk).to(tl.int64) + tl.arange(0, LENGTH)
    inside = is_one & (place < tl.load(starts + chunk + 1, mask=is_one, other=0))
    i = tl.load(ids + tl.load(order + place, mask=inside, other=0), mask=inside, other=0).to(tl.int64)
    for k in tl.static_range(2):
        add_nonzero(v_means + 2 * i + k, tl.load(v_means_copies + 2 * place + k, mask=inside, other=0.0), inside)
    for k in tl.static_range(3):
        add_nonzero(v_conics + 3 * i + k, tl.load(v_conics_copies + 3 * place + k, mask=inside, other=0.0), inside)
    for k in tl.static_range(CHANNELS):
        value = tl.load(v_values_copies + CHANNELS * place + k, mask=inside, other=0.0)
        add_nonzero(v_values + CHANNELS * i + k, value, inside)
    add_nonzero(v_opacities + i, tl.load(v_opacities_copies + place, mask=inside, other=0.0), inside)
