"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, with gradients.

The lists of tiles are cut into chunks, which are composited in parallel: at the horizon a tile lists a hundred times as
many Gaussians as elsewhere. A first pass multiplies the transmittance of each chunk, the second starts every chunk with
the transmittance in front of it, and so ends each ray where one pass over the whole list would. Chunks are composited
in groups, (Gaussians, rays) at a time: transmittance within a group is a cumulative product.

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
from drivesplat.kernels.scan_part import MetPart, ScanPart
from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.kernels.triton.scan_chunks import (
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    NOTHING,
    RAYS,
    SIZES,
    SUMS,
    VALUES,
    alpha_on_rays,
    chunk_of,
    chunks_of,
    field_of,
    offsets_on_rays,
    ranges_on_rays,
    rays_of,
)
from drivesplat.kernels.triton.scan_gradients import add_gradients, remain
from drivesplat.kernels.triton.scan_tiles import ReachedTiles, reached_tiles, scan_lists

GROUP, GROUP_BACKWARD = 16, 8
"""Gaussians that are composited at a time."""
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
        chunks = chunks_of(gaussians, values, scan_lists(gaussians, part.tiles, reached, capacity))
        until = torch.zeros_like(part.azimuths) if until is None else until
        rays, numbers = [t.contiguous() for t in (part.within, part.elevations, until)], part.tiles.tiles
        shape, channels = part.azimuths.shape, values.shape[1]
        sizes, width = (*shape, numbers.shape[1], channels), triton.next_power_of_2(max(channels, 1))
        passes, middles = (values.new_empty(chunks.count, RAYS.value) for _ in range(2))
        sums = values.new_empty(chunks.count, SUMS.value + channels, RAYS.value)
        whole, out = [values.new_empty(shape) for _ in range(4)], values.new_empty(*shape, channels)
        _pass[(chunks.count,)](*chunks, numbers, *rays[:2], passes, *chunks.sizes, *sizes[:3], GROUP, num_warps=1)
        _arrive[(chunks.tiles,)](chunks.firsts, passes, JOINED, num_warps=1)
        _composite[(chunks.count,)](
            *chunks, numbers, *rays, passes, sums, middles, *chunks.sizes, *sizes, width, GROUP, num_warps=1
        )
        _join[(chunks.tiles,)](chunks.firsts, numbers, sums, middles, *whole, out, *sizes, JOINED, num_warps=1)
        range_sum, alpha, before, median = whole
        ctx.chunks, ctx.sizes, ctx.count = chunks, sizes, len(ranges)
        ctx.save_for_backward(numbers, *rays, passes, sums, range_sum, alpha, before, out)
        ctx.mark_non_differentiable(median)
        return range_sum, alpha, before, out, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        numbers, azimuths, elevations, until, passes, sums, *rendered = ctx.saved_tensors
        chunks, sizes = ctx.chunks, ctx.sizes
        v_rendered, rest = [gradient.contiguous() for gradient in gradients[:4]], torch.empty_like(passes)
        remain[(chunks.tiles,)](chunks.firsts, numbers, sums, *rendered, *v_rendered, rest, *sizes, JOINED, num_warps=1)
        v_gaussians = [passes.new_zeros(ctx.count, *width) for width in ((2,), (), (3,), (2,), (), (sizes[3],))]
        add_gradients[(chunks.count,)](
            *chunks, numbers, azimuths, elevations, until, passes, rest, *v_rendered, *v_gaussians, *chunks.sizes,
            *sizes, GROUP_BACKWARD, num_warps=1,
        )  # fmt: skip
        v_means2d, v_ranges, v_conics, v_slopes, v_opacities, v_values = v_gaussians
        return v_means2d, v_ranges, v_conics, v_slopes, None, None, v_opacities, v_values, None, None, None, None


def composite_parts(met: Sequence[MetPart], values: Tensor) -> list[tuple[Tensor, ...]]:
    """The results of `ScanCompositing` for each part of a scan. The host waits for the device once."""
    reached = [reached_tiles(part.gaussians, part.rays.tiles) if len(values) else None for part in met]
    capacities = capacities_for([tiles.ends[-1] for tiles in reached if tiles is not None]) or [0] * len(met)
    lists = zip(met, reached, capacities, strict=True)
    return [
        ScanCompositing.apply(*part.gaussians, values, part.rays, part.until, tiles, capacity)
        for part, tiles, capacity in lists
    ]


@triton.jit(do_not_specialize=SIZES)
@no_type_check
def _pass(
    entries, ids, offsets, firsts, numbers, azimuths, elevations, passes, capacity, tiles, steps, beams, firings,
    across, GROUP: tl.constexpr,
):  # fmt: skip
    """Writes the transmittance of each chunk."""
    chunk = tl.program_id(0)
    tile, place, end = chunk_of(chunk, offsets, firsts, tiles, steps)
    if tile >= 0:
        ray, inside = rays_of(tile, numbers, beams, firings, across)
        azimuth = tl.load(azimuths + ray, mask=inside, other=0.0)[None, :]
        elevation = tl.load(elevations + ray, mask=inside, other=0.0)[None, :]
        left = tl.where(inside, 1.0, 0.0)
        remaining = tl.max(left, 0)
        while (place < end) & (remaining > NOTHING):
            at = place + tl.arange(0, GROUP)
            da, de = offsets_on_rays(entries, capacity, at, end, azimuth, elevation)
            alpha = tl.minimum(alpha_on_rays(entries, capacity, at, end, da, de), MAX_ALPHA)
            left *= tl.min(tl.cumprod(1.0 - alpha, 0), 0)
            remaining = tl.max(left, 0)
            place += GROUP
        tl.store(passes + chunk * RAYS + tl.arange(0, RAYS), tl.maximum(left, NOTHING))


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


@triton.jit(do_not_specialize=SIZES)
@no_type_check
def _composite(
    entries, ids, offsets, firsts, numbers, azimuths, elevations, until, passes, sums, middles, capacity, tiles, steps,
    beams, firings, across, CHANNELS: tl.constexpr, WIDTH: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    """Writes the sums of each chunk, and the median range where it lies in the chunk."""
    chunk = tl.program_id(0)
    tile, place, end = chunk_of(chunk, offsets, firsts, tiles, steps)
    if tile >= 0:
        ray, inside = rays_of(tile, numbers, beams, firings, across)
        own = tl.arange(0, RAYS)
        left = tl.where(inside, tl.load(passes + chunk * RAYS + own), 0.0)
        azimuth = tl.load(azimuths + ray, mask=inside, other=0.0)[None, :]
        elevation = tl.load(elevations + ray, mask=inside, other=0.0)[None, :]
        border = tl.load(until + ray, mask=inside, other=0.0)[None, :]
        total, ranges = tl.zeros((RAYS,), tl.float32), tl.zeros((RAYS,), tl.float32)
        nearer, middle = tl.zeros((RAYS,), tl.float32), tl.zeros((RAYS,), tl.float32)
        channel, shown = tl.arange(0, WIDTH)[:, None], tl.zeros((WIDTH, RAYS), tl.float32)
        remaining = tl.max(left, 0)
        while (place < end) & (remaining > MIN_TRANSMITTANCE):
            at = place + tl.arange(0, GROUP)
            da, de = offsets_on_rays(entries, capacity, at, end, azimuth, elevation)
            alpha = tl.minimum(alpha_on_rays(entries, capacity, at, end, da, de), MAX_ALPHA)
            distance, _ = ranges_on_rays(entries, capacity, at, end, da, de)
            after = left[None, :] * tl.cumprod(1.0 - alpha, 0)
            reaches = after / (1.0 - alpha)
            weight = tl.where(after > MIN_TRANSMITTANCE, alpha * reaches, 0.0)
            total += tl.sum(weight, 0)
            ranges += tl.sum(weight * distance, 0)
            nearer += tl.sum(tl.where(distance < border, weight, 0.0), 0)
            middle += tl.sum(tl.where((reaches > 0.5) & (after <= 0.5), distance, 0.0), 0)
            for k in tl.static_range(CHANNELS):
                seen = weight * field_of(entries, VALUES + k, capacity, at, end)
                shown += tl.where(channel == k, tl.sum(seen, 0)[None, :], 0.0)
            left = tl.min(after, 0)
            remaining = tl.max(left, 0)
            place += GROUP
        target = sums + chunk * (SUMS + CHANNELS) * RAYS + own
        tl.store(target, ranges)
        tl.store(target + RAYS, total)
        tl.store(target + 2 * RAYS, nearer)
        tl.store(target[None, :] + (SUMS + channel) * RAYS, shown, mask=channel < CHANNELS)
        tl.store(middles + chunk * RAYS + own, middle)


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
