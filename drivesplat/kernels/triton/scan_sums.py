"""The sums of the chunks of a LiDAR scan's lists by Triton's kernels; see scan_compositing.py.

Chunks are composited in groups, (Gaussians, rays) at a time: transmittance within a group is a cumulative product.
"""

from dataclasses import dataclass
from typing import no_type_check

import triton
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from drivesplat.kernels.scan_chunks import RaySums, ScanChunks, ScanGradients, TileRays
from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.kernels.triton.scan_chunks import (
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    NOTHING,
    RAYS,
    SIZES,
    SUMS,
    VALUES,
    ScanEntries,
    alpha_on_rays,
    chunk_of,
    chunks_of,
    field_of,
    offsets_on_rays,
    ranges_on_rays,
    rays_of,
)
from drivesplat.kernels.triton.scan_gradients import add_gradients
from drivesplat.kernels.triton.tiles import TileLists

GROUP, GROUP_BACKWARD = 16, 8
"""Gaussians that are composited at a time."""


@dataclass(frozen=True)
class CopiedChunks(ScanChunks):
    """Chunks with a copy of the Gaussian of each entry."""

    chunks: ScanEntries
    channels: int

    @classmethod
    def of(cls, gaussians: ScannedGaussians, values: Tensor, lists: TileLists) -> "CopiedChunks":
        return cls(chunks_of(gaussians, values, lists), values.shape[1])

    @property
    def firsts(self) -> Int[Tensor, " t1"]:
        return self.chunks.firsts

    @property
    def count(self) -> int:
        return self.chunks.count

    def write_transmittances(self, rays: TileRays, passes: Tensor) -> None:
        _pass[(self.count,)](*self.chunks, *rays[:3], passes, *self.chunks.sizes, *rays.sizes, GROUP, num_warps=1)

    def write_sums(self, rays: TileRays, passes: Tensor, sums: Tensor, middles: Tensor) -> None:
        width = triton.next_power_of_2(max(self.channels, 1))
        _composite[(self.count,)](
            *self.chunks, *rays, passes, sums, middles, *self.chunks.sizes, *rays.sizes, self.channels, width, GROUP,
            num_warps=1,
        )  # fmt: skip

    def add_gradients(
        self, rays: TileRays, passes: Tensor, rests: Tensor, given: RaySums, gradients: ScanGradients
    ) -> None:
        add_gradients[(self.count,)](
            *self.chunks, *rays, passes, rests, *given, *gradients, *self.chunks.sizes, *rays.sizes, self.channels,
            GROUP_BACKWARD, num_warps=1,
        )  # fmt: skip


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
