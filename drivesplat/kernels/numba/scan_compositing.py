"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, with gradients."""

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba import scan_tiles
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.scan_rays import MOMENTS, composite_rays, composite_rays_backward
from drivesplat.kernels.numba.scan_tiles import Arcs, by_range, scan_lists
from drivesplat.kernels.numba.threads import parallel_for
from drivesplat.kernels.scan_borders import ScanBorders

CHUNK = 4
"""Tiles per chunk: few, so that threads finish at the same time."""


class NumbaScanCompositing(torch.autograd.Function):
    """Sums of ranges, alpha, alpha before `until` and values along rays, and the median range without gradient; see
    `drivesplat.kernels.scan_compositing.CompositedScan`. Azimuths are within ±π; gradients reach neither rays nor
    `range_limits`."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Float[Tensor, "n 2"],
        ranges: Float[Tensor, " n"],
        conics: Float[Tensor, "n 3"],
        slopes: Float[Tensor, "n 2"],
        range_limits: Float[Tensor, " n"],
        radii: Float[Tensor, "n 2"],
        opacities: Float[Tensor, " n"],
        values: Float[Tensor, "n channels"],
        azimuths: Float[Tensor, "b a"],
        elevations: Float[Tensor, "b a"],
        until: Float[Tensor, "b a"],
        borders: ScanBorders,
    ) -> tuple[Tensor, ...]:
        sums = [means2d.new_empty(azimuths.shape) for _ in range(4)]
        out = means2d.new_empty((*azimuths.shape, values.shape[1]))
        range_sum, alpha, before, median = sums
        arcs, rays, lists = Arcs.of(borders), arrays(azimuths, elevations, until), None
        splats = by_range(*arrays(means2d, ranges, conics, slopes, range_limits, radii, opacities, values), arcs)
        tiles = arrays(borders.centers, borders.half_widths, borders.beam_lows, borders.beam_highs)
        for lists in scan_lists(splats, arcs):
            parallel_for(
                composite_rays, lists.last - lists.first, CHUNK,
                lists.first, lists.offsets, lists.ranks, splats.shapes, splats.values, *tiles, *rays,
                *arrays(*sums, out),
            )  # fmt: skip
        whole = lists is not None and lists.last - lists.first == arcs.tiles
        ctx.scan = splats, arcs, tiles, rays, lists if whole else None
        ctx.save_for_backward(means2d, range_sum, alpha, before, out)
        ctx.mark_non_differentiable(median)
        return range_sum, alpha, before, out, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_range_sum: Tensor, v_alpha: Tensor, v_before: Tensor, v_out: Tensor, _: Tensor) -> tuple:
        means2d, *rendered = ctx.saved_tensors
        splats, arcs, tiles, rays, lists = ctx.scan
        n, channels = len(means2d), v_out.shape[2]
        v_inputs = [means2d.new_zeros((n, *size)) for size in ((2,), (), (3,), (2,), (), (channels,))]
        images = arrays(*rendered, v_range_sum, v_alpha, v_before, v_out)
        for window in [lists] if lists is not None else scan_lists(splats, arcs):
            sums = np.zeros((len(window.ranks), MOMENTS + channels), splats.shapes.dtype)
            parallel_for(
                composite_rays_backward, window.last - window.first, CHUNK,
                window.first, window.offsets, window.ranks, window.slots, splats.shapes, splats.values, *tiles,
                *rays, *images, sums,
            )  # fmt: skip
            parallel_for(
                _sum_entries, len(splats.order), 4096,
                splats.order, splats.shapes, window.slot_offsets, sums, *arrays(*v_inputs),
            )  # fmt: skip
        v_means2d, v_ranges, v_conics, v_slopes, v_opacities, v_values = v_inputs
        return v_means2d, v_ranges, v_conics, v_slopes, None, None, v_opacities, v_values, None, None, None, None


@kernel
@no_type_check
def _sum_entries(
    start, stop, order, shapes, slot_offsets, sums, v_means2d, v_ranges, v_conics, v_slopes, v_opacities, v_values
):
    """Adds the gradients of all entries of Gaussians `start` to `stop`, in the order of their tiles."""
    channels, width = v_values.shape[1], sums.shape[1]
    total = np.empty(width)
    for r in range(start, stop):
        total[:] = 0.0
        for slot in range(slot_offsets[r], slot_offsets[r + 1]):
            for k in range(width):
                total[k] += sums[slot, k]
        g, shape = order[r], shapes[r]
        a, b, c = shape[scan_tiles.CONIC_AA], shape[scan_tiles.CONIC_AE], shape[scan_tiles.CONIC_EE]
        v_opacities[g] += total[0] / shape[scan_tiles.OPACITY]
        v_means2d[g, 0] += a * total[1] + b * total[2] - shape[scan_tiles.SLOPE_A] * total[7]
        v_means2d[g, 1] += b * total[1] + c * total[2] - shape[scan_tiles.SLOPE_E] * total[7]
        v_conics[g, 0] -= 0.5 * total[3]
        v_conics[g, 1] -= total[4]
        v_conics[g, 2] -= 0.5 * total[5]
        v_ranges[g] += total[6]
        v_slopes[g, 0] += total[8]
        v_slopes[g, 1] += total[9]
        for k in range(channels):
            v_values[g, k] += total[MOMENTS + k]
