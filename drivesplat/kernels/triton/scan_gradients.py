"""The gradients of the Gaussians of a LiDAR scan, chunk by chunk; see scan_compositing.py."""

from typing import no_type_check

import triton
import triton.language as tl

from drivesplat.kernels.triton.rows import add_nonzero
from drivesplat.kernels.triton.scan_chunks import (
    CONIC_AA,
    CONIC_AE,
    CONIC_EE,
    MAX_ALPHA,
    MIN_TRANSMITTANCE,
    NOTHING,
    OPACITY,
    RAYS,
    SIZES,
    SLOPE_A,
    SLOPE_E,
    SUMS,
    VALUES,
    alpha_on_rays,
    chunk_of,
    field_of,
    offsets_on_rays,
    ranges_on_rays,
    rays_of,
)


@triton.jit(do_not_specialize=SIZES[3:])
@no_type_check
def remain(
    firsts, numbers, sums, range_sum, alpha, before, out, v_range_sum, v_alpha, v_before, v_out, rest, beams, firings,
    across, CHANNELS: tl.constexpr, JOINED: tl.constexpr,
):  # fmt: skip
    """Writes the remaining sum in front of each chunk of a tile."""
    tile = tl.program_id(0)
    ray, inside = rays_of(tile, numbers, beams, firings, across)
    by_range = tl.load(v_range_sum + ray, mask=inside, other=0.0)
    by_alpha = tl.load(v_alpha + ray, mask=inside, other=0.0)
    by_nearer = tl.load(v_before + ray, mask=inside, other=0.0)
    left = by_range * tl.load(range_sum + ray, mask=inside, other=0.0)
    left += by_alpha * tl.load(alpha + ray, mask=inside, other=0.0)
    left += by_nearer * tl.load(before + ray, mask=inside, other=0.0)
    for k in tl.static_range(CHANNELS):
        shown = tl.load(out + CHANNELS * ray + k, mask=inside, other=0.0)
        left += shown * tl.load(v_out + CHANNELS * ray + k, mask=inside, other=0.0)
    own, step = tl.arange(0, RAYS)[None, :], tl.arange(0, JOINED)[:, None]
    chunk, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    while chunk < last:
        exists, source = chunk + step < last, sums + (chunk + step) * (SUMS + CHANNELS) * RAYS + own
        seen = by_range[None, :] * tl.load(source, mask=exists, other=0.0)
        seen += by_alpha[None, :] * tl.load(source + RAYS, mask=exists, other=0.0)
        seen += by_nearer[None, :] * tl.load(source + 2 * RAYS, mask=exists, other=0.0)
        for k in tl.static_range(CHANNELS):
            by_value = tl.load(v_out + CHANNELS * ray + k, mask=inside, other=0.0)[None, :]
            seen += by_value * tl.load(source + (SUMS + k) * RAYS, mask=exists, other=0.0)
        in_front = tl.cumsum(seen, 0) - seen
        tl.store(rest + (chunk + step) * RAYS + own, left[None, :] - in_front, mask=exists)
        left -= tl.sum(seen, 0)
        chunk += JOINED


@triton.jit(do_not_specialize=SIZES)
@no_type_check
def add_gradients(
    entries, ids, offsets, firsts, numbers, azimuths, elevations, until, passes, rests, v_range_sum, v_alpha, v_before,
    v_out, v_means2d, v_ranges, v_conics, v_slopes, v_opacities, v_values, capacity, tiles, steps, beams, firings,
    across, CHANNELS: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    """Adds the gradients of each chunk to those of its Gaussians."""
    chunk = tl.program_id(0)
    tile, place, end = chunk_of(chunk, offsets, firsts, tiles, steps)
    if tile >= 0:
        ray, inside = rays_of(tile, numbers, beams, firings, across)
        azimuth = tl.load(azimuths + ray, mask=inside, other=0.0)[None, :]
        elevation = tl.load(elevations + ray, mask=inside, other=0.0)[None, :]
        border = tl.load(until + ray, mask=inside, other=0.0)[None, :]
        by_range = tl.load(v_range_sum + ray, mask=inside, other=0.0)[None, :]
        by_alpha = tl.load(v_alpha + ray, mask=inside, other=0.0)[None, :]
        by_nearer = tl.load(v_before + ray, mask=inside, other=0.0)[None, :]
        rest = tl.load(rests + chunk * RAYS + tl.arange(0, RAYS))
        left = tl.where(inside, tl.load(passes + chunk * RAYS + tl.arange(0, RAYS)), 0.0)
        remaining = tl.max(left, 0)
        while (place < end) & (remaining > MIN_TRANSMITTANCE):
            at = place + tl.arange(0, GROUP)
            exists = at < end
            i = tl.load(ids + at, mask=exists, other=0).to(tl.int64)
            da, de = offsets_on_rays(entries, capacity, at, end, azimuth, elevation)
            raw = alpha_on_rays(entries, capacity, at, end, da, de)
            distance, free = ranges_on_rays(entries, capacity, at, end, da, de)
            alpha = tl.minimum(raw, MAX_ALPHA)
            after = left[None, :] * tl.cumprod(1.0 - alpha, 0)
            reaches = after / (1.0 - alpha)
            continues = after > MIN_TRANSMITTANCE
            weight = tl.where(continues, alpha * reaches, 0.0)
            value = by_alpha + tl.where(distance < border, by_nearer, 0.0) + distance * by_range
            for k in tl.static_range(CHANNELS):
                by_value = tl.load(v_out + CHANNELS * ray + k, mask=inside, other=0.0)[None, :]
                value += field_of(entries, VALUES + k, capacity, at, end) * by_value
                add_nonzero(v_values + CHANNELS * i + k, tl.sum(weight * by_value, 1), exists)
            seen = weight * value
            behind = rest[None, :] - tl.cumsum(seen, 0)
            v = raw * (reaches * value - behind / (1.0 - alpha))
            v = tl.where(continues & (raw <= MAX_ALPHA), v, 0.0)
            of_range = weight * by_range
            unlimited = tl.where(free, of_range, 0.0)
            m_a, m_e = tl.sum(v * da, 1)[:, None], tl.sum(v * de, 1)[:, None]
            f = tl.sum(unlimited, 1)[:, None]
            a, b = field_of(entries, CONIC_AA, capacity, at, end), field_of(entries, CONIC_AE, capacity, at, end)
            c, opacity = field_of(entries, CONIC_EE, capacity, at, end), field_of(entries, OPACITY, capacity, at, end)
            slope_a = field_of(entries, SLOPE_A, capacity, at, end)
            slope_e = field_of(entries, SLOPE_E, capacity, at, end)
            add_nonzero(v_opacities + i, tl.sum(v, 1) / tl.maximum(tl.max(opacity, 1), NOTHING), exists)
            add_nonzero(v_means2d + 2 * i, tl.max(a * m_a + b * m_e - slope_a * f, 1), exists)
            add_nonzero(v_means2d + 2 * i + 1, tl.max(b * m_a + c * m_e - slope_e * f, 1), exists)
            add_nonzero(v_conics + 3 * i, -0.5 * tl.sum(v * da * da, 1), exists)
            add_nonzero(v_conics + 3 * i + 1, -tl.sum(v * da * de, 1), exists)
            add_nonzero(v_conics + 3 * i + 2, -0.5 * tl.sum(v * de * de, 1), exists)
            add_nonzero(v_ranges + i, tl.sum(of_range, 1), exists)
            add_nonzero(v_slopes + 2 * i, tl.sum(unlimited * da, 1), exists)
            add_nonzero(v_slopes + 2 * i + 1, tl.sum(unlimited * de, 1), exists)
            rest -= tl.sum(seen, 0)
            left = tl.min(after, 0)
            remaining = tl.max(left, 0)
            place += GROUP
