"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, with gradients.

A program composites a tile. It takes the list's Gaussians in groups, (Gaussians, rays) at a time: transmittance within
a group is a cumulative product. The backward pass runs front to back like the forward pass: with the loss's gradients g
of a ray's sums, weights w = T alpha and the remaining sum R_i = sum over j > i of w_j (g · value_j), the gradient of
alpha_i is T_i (g · value_i) - R_i / (1 - alpha_i), and the sum over all j is known from the rendered scan.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.scan_borders import ON_GPU
from drivesplat.kernels.scan_part import ScanPart
from drivesplat.kernels.scan_projection import MIN_ALPHA, ScannedGaussians
from drivesplat.kernels.triton.scan_tiles import scan_lists
from drivesplat.kernels.triton.vectors import around

GROUP, GROUP_BACKWARD = 16, 8
"""Gaussians that are composited at a time."""
WARPS = 2
BEAMS, FIRINGS = tl.constexpr(ON_GPU.beams), tl.constexpr(ON_GPU.firings)
RAYS = tl.constexpr(ON_GPU.beams * ON_GPU.firings)
FAINTEST, MAX_ALPHA, MIN_TRANSMITTANCE = tl.constexpr(MIN_ALPHA), tl.constexpr(0.999), tl.constexpr(1e-4)


class ScanCompositing(torch.autograd.Function):
    """Sums of ranges, alpha, alpha before `until` and values along rays, and the median range without gradient, in the
    order of `drivesplat.kernels.scan_compositing.CompositedScan`. Gradients reach neither rays nor `range_limits`."""

    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, ranges: Tensor, conics: Tensor, slopes: Tensor, range_limits: Tensor, radii: Tensor,
        opacities: Tensor, values: Tensor, part: ScanPart, until: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        gaussians = ScannedGaussians(means2d, ranges, conics, slopes, range_limits, radii, opacities)
        lists, (beams, firings) = scan_lists(gaussians, part.columns), part.azimuths.shape
        range_sum, alpha, before, median = (means2d.new_empty(beams, firings) for _ in range(4))
        out = means2d.new_empty(beams, firings, values.shape[1])
        drawn = [t.contiguous() for t in (means2d, ranges, conics, slopes, range_limits, opacities, values)]
        rays = [t.contiguous() for t in (part.within, part.elevations, until)]
        columns = part.columns.columns
        _composite[(columns.numel(),)](
            *drawn, *lists[:3], columns, *rays, range_sum, alpha, before, out, median, beams, firings,
            columns.shape[1], values.shape[1], triton.next_power_of_2(max(values.shape[1], 1)), GROUP, num_warps=WARPS,
        )  # fmt: skip
        ctx.save_for_backward(*drawn, *lists[:3], columns, *rays, range_sum, alpha, before, out)
        ctx.mark_non_differentiable(median)
        return range_sum, alpha, before, out, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        means2d, ranges, conics, slopes, _, opacities, values = saved[:7]
        columns, (beams, firings) = saved[10], saved[11].shape
        v_seen = [gradient.contiguous() for gradient in gradients[:4]]
        v_drawn = [torch.zeros_like(tensor) for tensor in (means2d, ranges, conics, slopes, opacities, values)]
        _composite_backward[(columns.numel(),)](
            *saved, *v_seen, *v_drawn, beams, firings, columns.shape[1], values.shape[1], GROUP_BACKWARD,
            num_warps=WARPS,
        )  # fmt: skip
        v_means2d, v_ranges, v_conics, v_slopes, v_opacities, v_values = v_drawn
        return v_means2d, v_ranges, v_conics, v_slopes, None, None, v_opacities, v_values, None, None


@triton.jit
@no_type_check
def _rays(tile, columns, beams, firings, across):
    """The indices of a tile's rays, and which of them are in the scan."""
    ray = tl.arange(0, RAYS)
    row = tile // across
    beam, firing = row * BEAMS + ray // FIRINGS, tl.load(columns + tile) * FIRINGS + ray % FIRINGS
    return beam * firings + firing, (beam < beams) & (firing < firings)


@triton.jit
@no_type_check
def _group(
    means2d, ranges, conics, slopes, limits, opacities, ids, order, place, end, azimuth, elevation
):  # fmt: skip
    """The Gaussians of some entries (k, 1) on all rays (1, r): their indices, which exist, offsets of the rays from
    their centres, conics, slopes, limits, corrections of the range before they are limited, ranges, opacities, and
    alpha before it is limited."""
    exists = place < end
    i = tl.load(ids + tl.load(order + place, mask=exists, other=0), mask=exists, other=0)
    da = around(azimuth - tl.load(means2d + 2 * i, mask=exists, other=0.0)[:, None])
    de = elevation - tl.load(means2d + 2 * i + 1, mask=exists, other=0.0)[:, None]
    a = tl.load(conics + 3 * i, mask=exists, other=1.0)[:, None]
    b = tl.load(conics + 3 * i + 1, mask=exists, other=0.0)[:, None]
    c = tl.load(conics + 3 * i + 2, mask=exists, other=1.0)[:, None]
    opacity = tl.load(opacities + i, mask=exists, other=0.0)[:, None]
    exponent = -(0.5 * a * da + b * de) * da - 0.5 * c * de * de
    raw = opacity * tl.exp(tl.minimum(exponent, 0.0))
    raw = tl.where((exponent <= 0.0) & (raw >= FAINTEST), raw, 0.0)
    slope_a = tl.load(slopes + 2 * i, mask=exists, other=0.0)[:, None]
    slope_e = tl.load(slopes + 2 * i + 1, mask=exists, other=0.0)[:, None]
    correction = slope_a * da + slope_e * de
    limit = tl.load(limits + i, mask=exists, other=0.0)[:, None]
    center = tl.load(ranges + i, mask=exists, other=0.0)[:, None]
    distance = center + tl.maximum(tl.minimum(correction, limit), -limit)
    free = tl.abs(correction) <= limit
    return i, exists, da, de, a, b, c, slope_a, slope_e, opacity, raw, distance, free


@triton.jit(do_not_specialize=["beams", "firings", "across"])
@no_type_check
def _composite(
    means2d, ranges, conics, slopes, limits, opacities, values, ids, order, offsets, columns, azimuths, elevations,
    until, range_sum, alpha, before, out, median, beams, firings, across, CHANNELS: tl.constexpr, WIDTH: tl.constexpr,
    GROUP: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    ray, inside = _rays(tile, columns, beams, firings, across)
    azimuth = tl.load(azimuths + ray, mask=inside, other=0.0)[None, :]
    elevation = tl.load(elevations + ray, mask=inside, other=0.0)[None, :]
    border = tl.load(until + ray, mask=inside, other=0.0)[None, :]
    passes = tl.where(inside, 1.0, 0.0)
    total, total_range = tl.zeros((RAYS,), tl.float32), tl.zeros((RAYS,), tl.float32)
    nearer, middle = tl.zeros((RAYS,), tl.float32), tl.zeros((RAYS,), tl.float32)
    place, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    channel, shown = tl.arange(0, WIDTH)[:, None], tl.zeros((WIDTH, RAYS), tl.float32)
    remaining = tl.max(passes, 0)
    while (place < end) & (remaining > MIN_TRANSMITTANCE):
        i, exists, _, _, _, _, _, _, _, _, raw, distance, _ = _group(
            means2d, ranges, conics, slopes, limits, opacities, ids, order, place + tl.arange(0, GROUP), end,
            azimuth, elevation,
        )  # fmt: skip
        opaque = tl.minimum(raw, MAX_ALPHA)
        after = passes[None, :] * tl.cumprod(1.0 - opaque, 0)
        reaches = after / (1.0 - opaque)
        weight = tl.where(after > MIN_TRANSMITTANCE, opaque * reaches, 0.0)
        total += tl.sum(weight, 0)
        total_range += tl.sum(weight * distance, 0)
        nearer += tl.sum(tl.where(distance < border, weight, 0.0), 0)
        middle += tl.sum(tl.where((reaches > 0.5) & (after <= 0.5), distance, 0.0), 0)
        for k in tl.static_range(CHANNELS):
            value = tl.load(values + CHANNELS * i + k, mask=exists, other=0.0)[:, None]
            shown += tl.where(channel == k, tl.sum(weight * value, 0)[None, :], 0.0)
        passes = tl.min(after, 0)
        remaining = tl.max(passes, 0)
        place += GROUP
    tl.store(range_sum + ray, total_range, mask=inside)
    tl.store(alpha + ray, total, mask=inside)
    tl.store(before + ray, nearer, mask=inside)
    tl.store(median + ray, middle, mask=inside)
    tl.store(out + CHANNELS * ray[None, :] + channel, shown, mask=inside[None, :] & (channel < CHANNELS))


@triton.jit
@no_type_check
def _add(target, value, mask):
    """Adds values other than 0."""
    tl.atomic_add(target, value, mask=mask & (value != 0.0), sem="relaxed")


@triton.jit(do_not_specialize=["beams", "firings", "across"])
@no_type_check
def _composite_backward(
    means2d, ranges, conics, slopes, limits, opacities, values, ids, order, offsets, columns, azimuths, elevations,
    until, range_sum, alpha, before, out, v_range_sum, v_alpha, v_before, v_out, v_means2d, v_ranges, v_conics,
    v_slopes, v_opacities, v_values, beams, firings, across, CHANNELS: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    tile = tl.program_id(0)
    ray, inside = _rays(tile, columns, beams, firings, across)
    azimuth = tl.load(azimuths + ray, mask=inside, other=0.0)[None, :]
    elevation = tl.load(elevations + ray, mask=inside, other=0.0)[None, :]
    border = tl.load(until + ray, mask=inside, other=0.0)[None, :]
    by_range = tl.load(v_range_sum + ray, mask=inside, other=0.0)
    by_alpha = tl.load(v_alpha + ray, mask=inside, other=0.0)
    by_nearer = tl.load(v_before + ray, mask=inside, other=0.0)
    rest = by_range * tl.load(range_sum + ray, mask=inside, other=0.0)
    rest += by_alpha * tl.load(alpha + ray, mask=inside, other=0.0)
    rest += by_nearer * tl.load(before + ray, mask=inside, other=0.0)
    for k in tl.static_range(CHANNELS):
        shown = tl.load(out + CHANNELS * ray + k, mask=inside, other=0.0)
        rest += shown * tl.load(v_out + CHANNELS * ray + k, mask=inside, other=0.0)
    passes = tl.where(inside, 1.0, 0.0)
    place, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    remaining = tl.max(passes, 0)
    while (place < end) & (remaining > MIN_TRANSMITTANCE):
        i, exists, da, de, a, b, c, slope_a, slope_e, opacity, raw, distance, free = _group(
            means2d, ranges, conics, slopes, limits, opacities, ids, order, place + tl.arange(0, GROUP), end,
            azimuth, elevation,
        )  # fmt: skip
        opaque = tl.minimum(raw, MAX_ALPHA)
        left = 1.0 - opaque
        after = passes[None, :] * tl.cumprod(left, 0)
        reaches = after / left
        continues = after > MIN_TRANSMITTANCE
        weight = tl.where(continues, opaque * reaches, 0.0)
        value = by_alpha[None, :] + tl.where(distance < border, by_nearer[None, :], 0.0) + distance * by_range[None, :]
        for k in tl.static_range(CHANNELS):
            own = tl.load(values + CHANNELS * i + k, mask=exists, other=0.0)[:, None]
            by_value = tl.load(v_out + CHANNELS * ray + k, mask=inside, other=0.0)[None, :]
            value += own * by_value
            _add(v_values + CHANNELS * i + k, tl.sum(weight * by_value, 1), exists)
        seen = weight * value
        behind = rest[None, :] - tl.cumsum(seen, 0)
        v = tl.where(continues & (raw <= MAX_ALPHA), raw * (reaches * value - behind / left), 0.0)
        of_range = weight * by_range[None, :]
        unlimited = tl.where(free, of_range, 0.0)
        m_a, m_e, f = tl.sum(v * da, 1)[:, None], tl.sum(v * de, 1)[:, None], tl.sum(unlimited, 1)[:, None]
        _add(v_opacities + i, tl.sum(v / tl.maximum(opacity, FAINTEST), 1), exists)
        _add(v_means2d + 2 * i, tl.sum(a * m_a + b * m_e - slope_a * f, 1), exists)
        _add(v_means2d + 2 * i + 1, tl.sum(b * m_a + c * m_e - slope_e * f, 1), exists)
        _add(v_conics + 3 * i, -0.5 * tl.sum(v * da * da, 1), exists)
        _add(v_conics + 3 * i + 1, -tl.sum(v * da * de, 1), exists)
        _add(v_conics + 3 * i + 2, -0.5 * tl.sum(v * de * de, 1), exists)
        _add(v_ranges + i, tl.sum(of_range, 1), exists)
        _add(v_slopes + 2 * i, tl.sum(unlimited * da, 1), exists)
        _add(v_slopes + 2 * i + 1, tl.sum(unlimited * de, 1), exists)
        rest -= tl.sum(seen, 0)
        passes = tl.min(after, 0)
        remaining = tl.max(passes, 0)
        place += GROUP
