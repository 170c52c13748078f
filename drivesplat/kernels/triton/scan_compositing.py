"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, with gradients.

The lists of tiles are cut into chunks, which are composited in parallel: at the horizon a tile lists a hundred times as
many Gaussians as elsewhere. A first pass multiplies the transmittance of each chunk, the second starts every chunk with
the transmittance in front of it, and so ends each ray where one pass over the whole list would. CUDA C++ kernels do so
where they compile, Triton's elsewhere.

The backward pass runs front to back, too: with the loss's gradients g of a ray's sums, weights w = T alpha and the
remaining sum R_i = sum over j > i of w_j (g · value_j), the gradient of alpha_i is T_i (g · value_i) - R_i / (1 -
alpha_i); the sum over all j is known from the rendered scan, and that of earlier chunks from their sums.
"""

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.capacity import capacities_for
from drivesplat.kernels.cuda import scans as cuda_scans
from drivesplat.kernels.scan_chunks import RaySums, ScanChunks, ScanGradients, TileRays
from drivesplat.kernels.scan_part import MetPart, ScanPart
from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.kernels.triton.scan_chunks import RAYS, SIZES, SUMS, rays_of
from drivesplat.kernels.triton.scan_gradients import remain
from drivesplat.kernels.triton.scan_sums import CopiedChunks
from drivesplat.kernels.triton.scan_tiles import ReachedTiles, reached_tiles, scan_lists
from drivesplat.kernels.triton.tiles import TileLists

JOINED = 8
"""Chunks of a tile that are joined at a time."""


class ScanCompositing(torch.autograd.Function):
    """Sums of ranges, alpha, alpha before `until` and values along rays, and the median range without gradient, in the
    order of `drivesplat.kernels.scan_compositing.CompositedScan`. Gradients reach neither rays nor `range_limits`."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, ranges: Tensor, conics: Tensor, slopes: Tensor, range_limits: Tensor, radii: Tensor,
        opacities: Tensor, values: Tensor, part: ScanPart, until: Tensor | None, reached: ReachedTiles | None,
        capacity: int,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        gaussians = ScannedGaussians(means2d, ranges, conics, slopes, range_limits, radii, opacities)
        chunks = _chunks_of(gaussians, values, scan_lists(gaussians, part.tiles, reached, capacity))
        until = torch.zeros_like(part.azimuths) if until is None else until
        given = [t.to(values).contiguous() for t in (part.within, part.elevations, until)]
        rays, shape, channels = TileRays(part.tiles.tiles, *given), part.azimuths.shape, values.shape[1]
        passes, middles = (values.new_empty(chunks.count, RAYS.value) for _ in range(2))
        sums = values.new_empty(chunks.count, SUMS.value + channels, RAYS.value)
        whole, out = [values.new_empty(shape) for _ in range(4)], values.new_empty(*shape, channels)
        tiles = (len(chunks.firsts) - 1,)
        chunks.write_transmittances(rays, passes)
        _arrive[tiles](chunks.firsts, passes, JOINED, num_warps=1)
        chunks.write_sums(rays, passes, sums, middles)
        _join[tiles](
            chunks.firsts, rays.numbers, sums, middles, *whole, out, *rays.sizes, channels, JOINED, num_warps=1
        )
        range_sum, alpha, before, median = whole
        ctx.chunks, ctx.channels, ctx.count = chunks, channels, len(ranges)
        # `chunks` may read these again: saved here, so that torch notices if they have changed by then
        read = means2d, ranges, conics, slopes, range_limits, opacities, values
        ctx.save_for_backward(*rays, passes, sums, range_sum, alpha, before, out, *read)
        ctx.mark_non_differentiable(median)
        return range_sum, alpha, before, out, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rays, saved = TileRays(*ctx.saved_tensors[:4]), ctx.saved_tensors[4:]
        passes, sums, rendered = *saved[:2], RaySums(*saved[2:6])
        given, rest = RaySums(*(gradient.contiguous() for gradient in gradients[:4])), torch.empty_like(passes)
        remain[(len(ctx.chunks.firsts) - 1,)](
            ctx.chunks.firsts, rays.numbers, sums, *rendered, *given, rest, *rays.sizes, ctx.channels, JOINED,
            num_warps=1,
        )  # fmt: skip
        widths = ((2,), (), (3,), (2,), (), (ctx.channels,))
        found = ScanGradients(*(passes.new_zeros(ctx.count, *width) for width in widths))
        ctx.chunks.add_gradients(rays, passes, rest, given, found)
        of_gaussians = found.means2d, found.ranges, found.conics, found.slopes, None, None, found.opacities
        return *of_gaussians, found.values, None, None, None, None


def _chunks_of(gaussians: ScannedGaussians, values: Tensor, lists: TileLists) -> ScanChunks:
    kind = cuda_scans.GatheredChunks if cuda_scans.can_composite(values) else CopiedChunks
    return kind.of(gaussians, values, lists)


def composite_parts(met: Sequence[MetPart], values: Tensor) -> list[tuple[Tensor, ...]]:
    """The results of `ScanCompositing` for each part of a scan. The host waits for the device once."""
    reached = [reached_tiles(part.gaussians, part.rays.tiles) if len(values) else None for part in met]
    capacities = capacities_for([tiles.ends[-1] for tiles in reached if tiles is not None]) or [0] * len(met)
    lists = zip(met, reached, capacities, strict=True)
    return [
        ScanCompositing.apply(*part.gaussians, values, part.rays, part.until, tiles, capacity)
        for part, tiles, capacity in lists
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
