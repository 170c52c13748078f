"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, with gradients.

The lists of tiles are cut into chunks, which are composited in parallel: at the horizon a tile lists a hundred times as
many Gaussians as elsewhere. A first pass multiplies the transmittance of each chunk, the second starts every chunk with
the transmittance in front of it, and so ends each ray where one pass over the whole list would. CUDA C++ kernels do so
where they compile, Triton's elsewhere.

The backward pass runs front to back, too: with the loss's gradients g of a ray's sums, weights w = T alpha and the
remaining sum R_i = sum over j > i of w_j (g · value_j), the gradient of alpha_i is T_i (g · value_i) - R_i / (1 -
alpha_i); the sum over all j is known from the rendered scan, and that of earlier chunks from their sums.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.capacity import capacities_for
from drivesplat.kernels.scan_chunks import RaySums, ScanChunks, ScanGradients, TileRays
from drivesplat.kernels.scan_part import MetPart, ScanPart
from drivesplat.kernels.scanned_gaussians import LEARNED, PROJECTED, ScannedGaussians
from drivesplat.kernels.triton.rows import ALIGNED
from drivesplat.kernels.triton.scan_chunks import RAYS, SIZES, SUMS, rays_of
from drivesplat.kernels.triton.scan_gradients import remain
from drivesplat.kernels.triton.scan_tiles import ReachedTiles, count_tiles, reached_tiles, scan_lists

JOINED = 8
"""Chunks of a tile that are joined at a time."""


class Listed(NamedTuple):
    """A part of a scan, the ranges (metres) before which alpha is wanted, too, the tiles that Gaussians reach, with the
    `capacity` of their lists, and the maker of their chunks."""

    part: ScanPart
    until: Float[Tensor, "b a"] | None
    reached: ReachedTiles | None
    capacity: int
    chunks_of: Callable[..., ScanChunks]


class TritonScanCompositing(torch.autograd.Function):
    """Sums of ranges, alpha, alpha before `until` and values along the rays of each part of a scan, and the median
    range without gradient, in the order of `drivesplat.kernels.scan_compositing.CompositedScan`, part after part.

    `projected` are the fields of the Gaussians of each part but their opacities. Gradients reach neither rays nor
    `range_limits`. Those of opacities and values are added for all parts in one place.
    """

    @staticmethod
    def forward(
        ctx: Any, opacities: Tensor, values: Tensor, parts: Sequence[Listed], *projected: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.chunks, ctx.shape, saved, found = [], values.shape, [opacities, values], []
        for listed, fields in zip(parts, _by_part(projected, len(PROJECTED)), strict=True):
            chunks, kept, seen = _composited(ScannedGaussians(*fields, opacities), values, listed)
            ctx.chunks.append(chunks)
            # `chunks` may read these again: saved here, so that torch notices if they have changed by then
            saved += [*kept, *fields[:-1]]
            found += seen
        ctx.save_for_backward(*saved)
        ctx.mark_non_differentiable(*found[4::5])
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        opacities, _, *saved = ctx.saved_tensors
        count, channels = ctx.shape
        by_part = _by_part(saved, len(saved) // len(ctx.chunks)), _by_part(gradients, 5)
        v_opacities, v_values, *zeros = _zeros(opacities, count, ((), (channels,), *len(ctx.chunks) * LEARNED))
        of_fields: list[Tensor | None] = []
        for chunks, kept, given, own in zip(ctx.chunks, *by_part, _by_part(zeros, len(LEARNED)), strict=True):
            rays, passes, sums, rendered = TileRays(*kept[:4]), kept[4], kept[5], RaySums(*kept[6:10])
            given = RaySums(*(gradient.contiguous() for gradient in given[:4]))
            rest = torch.empty_like(passes)
            remain[(len(chunks.firsts) - 1,)](
                chunks.firsts, rays.numbers, sums, *rendered, *given, rest, *rays.sizes, channels, JOINED, num_warps=1,
            )  # fmt: skip
            chunks.add_gradients(rays, passes, rest, given, ScanGradients(*own, v_opacities, v_values))
            of_fields += [*own, None, None]
        return v_opacities, v_values, None, *of_fields


def _by_part(tensors: Sequence[Tensor], each: int) -> list[Sequence[Tensor]]:
    """The tensors of each part; `each` is the number of those of a part."""
    return [tensors[at : at + each] for at in range(0, len(tensors), each)]


def _zeros(like: Tensor, count: int, shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """Tensors of zeros with so many rows of each shape, filled at once. All addresses are multiples of 16 bytes."""
    sizes = [count * math.prod(shape) for shape in shapes]
    padded = [triton.cdiv(size, ALIGNED) * ALIGNED for size in sizes]
    parts = zip(like.new_zeros(sum(padded)).split(padded), sizes, shapes, strict=True)
    return [values[:size].view(count, *shape) for values, size, shape in parts]


def _composited(
    gaussians: ScannedGaussians, values: Tensor, listed: Listed
) -> tuple[ScanChunks, list[Tensor], list[Tensor]]:
    """The chunks of a part, what its gradients need, and what its rays measure."""
    part = listed.part
    lists = scan_lists(gaussians, part.tiles, listed.reached, listed.capacity)
    chunks = listed.chunks_of(gaussians, values, lists)
    until = torch.zeros_like(part.azimuths) if listed.until is None else listed.until
    given = [t.to(values).contiguous() for t in (part.within, part.elevations, until)]
    rays, shape, channels = TileRays(part.tiles.tiles, *given), part.azimuths.shape, values.shape[1]
    passes, middles = (values.new_empty(chunks.count, RAYS.value) for _ in range(2))
    sums = values.new_empty(chunks.count, SUMS.value + channels, RAYS.value)
    whole, out = [values.new_empty(shape) for _ in range(4)], values.new_empty(*shape, channels)
    tiles = (len(chunks.firsts) - 1,)
    chunks.write_transmittances(rays, passes)
    _arrive[tiles](chunks.firsts, passes, JOINED, num_warps=1)
    chunks.write_sums(rays, passes, sums, middles)
    _join[tiles](chunks.firsts, rays.numbers, sums, middles, *whole, out, *rays.sizes, channels, JOINED, num_warps=1)
    range_sum, alpha, before, median = whole
    return chunks, [*rays, passes, sums, range_sum, alpha, before, out], [range_sum, alpha, before, out, median]


def composite_parts(
    met: Sequence[MetPart], values: Tensor, chunks_of: Callable[..., ScanChunks]
) -> list[tuple[Tensor, ...]]:
    """The results of `TritonScanCompositing` for each part of a scan. The host waits for the device once.

    `chunks_of` takes Gaussians, their values and the lists of tiles; its chunks choose the kernels.
    """
    parts = [Listed(part.rays, part.until, *lists, chunks_of) for part, lists in zip(met, _lists_of(met), strict=True)]
    projected = [field for part in met for field in part.gaussians[: len(PROJECTED)]]
    return _by_part(TritonScanCompositing.apply(met[0].gaussians.opacities, values, parts, *projected), 5)


def _lists_of(met: Sequence[MetPart]) -> list[tuple[ReachedTiles | None, int]]:
    """The tiles that Gaussians reach in each part, and the capacity of their lists."""
    count = len(met[0].gaussians.ranges)
    if count == 0:
        return [(None, 0)] * len(met)
    counted = [count_tiles(part.gaussians, part.rays.tiles) for part in met]
    capacities = capacities_for([needed for tiles in counted for needed in tiles.needed])
    return [
        (reached_tiles(part.gaussians, tiles, min(reached, count)), entries)
        for part, tiles, reached, entries in zip(met, counted, capacities[::2], capacities[1::2], strict=True)
    ]


@triton.jit
@no_type_check
def _arrive(firsts, passes, JOINED: tl.constexpr):
    """Replaces the transmittance of each chunk of a tile by that in front of it."""
    tile = tl.program_id(0)
    ray, step = tl.arange(0, RAYS)[None, :], tl.arange(0, JOINED)[:, None]
    chunk, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    before = tl.full((RAYS,), 1.0, tl.float32)
    while chunk < last:
        at, exists = passes + (chunk + step) * RAYS + ray, chunk + step < last
        own = tl.load(at, mask=exists, other=1.0)
        after = before[None, :] * tl.cumprod(own, 0)
        tl.store(at, after / own, mask=exists)
        before = tl.min(after, 0)
        chunk += JOINED


@triton.jit
@no_type_check
def _total(source, chunk, last, STRIDE: tl.constexpr, JOINED: tl.constexpr):
    """The sum of one of the sums over the chunks of a tile."""
    ray, step = tl.arange(0, RAYS)[None, :], tl.arange(0, JOINED)[:, None]
    total = tl.zeros((RAYS,), tl.float32)
    while chunk < last:
        total += tl.sum(tl.load(source + (chunk + step) * STRIDE + ray, mask=chunk + step < last, other=0.0), 0)
        chunk += JOINED
    return total


@triton.jit(do_not_specialize=SIZES[3:])
@no_type_check
def _join(
    firsts, numbers, sums, middles, range_sum, alpha, before, median, out, beams, firings, across,
    CHANNELS: tl.constexpr, JOINED: tl.constexpr,
):  # fmt: skip
    """Adds the sums of the chunks of a tile."""
    tile = tl.program_id(0)
    ray, inside = rays_of(tile, numbers, beams, firings, across)
    chunk, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    tl.store(range_sum + ray, _total(sums, chunk, last, (SUMS + CHANNELS) * RAYS, JOINED), mask=inside)
    tl.store(alpha + ray, _total(sums + RAYS, chunk, last, (SUMS + CHANNELS) * RAYS, JOINED), mask=inside)
    tl.store(before + ray, _total(sums + 2 * RAYS, chunk, last, (SUMS + CHANNELS) * RAYS, JOINED), mask=inside)
    tl.store(median + ray, _total(middles, chunk, last, RAYS, JOINED), mask=inside)
    for k in tl.static_range(CHANNELS):
        own = _total(sums + (SUMS + k) * RAYS, chunk, last, (SUMS + CHANNELS) * RAYS, JOINED)
        tl.store(out + CHANNELS * ray + k, own, mask=inside)
