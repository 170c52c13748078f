"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, front to back by range."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.scan_part import MetPart


class CompositedScan(NamedTuple):
    """Sums over the Gaussians of b beams and a firings, weighted with transmittance times alpha: `range_sum` of ranges
    in metres, `alpha` of 1, `values`, and `alpha_before` of those in front of `until`. `median_range`, without
    gradient, is the range at which transmittance falls to 0.5 or less, 0 where it does not."""

    range_sum: Float[Tensor, "b a"]
    alpha: Float[Tensor, "b a"]
    alpha_before: Float[Tensor, "b a"]
    values: Float[Tensor, "b a v"]
    median_range: Float[Tensor, "b a"]


def composite_scan(met: Sequence[MetPart], values: Float[Tensor, "n v"]) -> list[CompositedScan]:
    """Composites Gaussians along the rays of each part of a scan, by CUDA C++ kernels or Triton's on a GPU and in numba
    elsewhere. Where Triton cannot be used, or for float64, tensors on a GPU are copied to the CPU and back."""
    single = all(tensor.dtype == torch.float32 for tensor in (values, *met[0].gaussians))
    if triton_support.usable_for(values) and single:
        from drivesplat.kernels.cuda import scans
        from drivesplat.kernels.triton.scan_compositing import composite_parts
        from drivesplat.kernels.triton.scan_sums import CopiedChunks

        kind = scans.GatheredChunks if scans.can_composite(values) else CopiedChunks
        return [CompositedScan(*composited) for composited in composite_parts(met, values, kind.of)]
    return [_on_cpu(part, values) for part in met]


def _on_cpu(met: MetPart, values: Float[Tensor, "n v"]) -> CompositedScan:
    from drivesplat.kernels.numba.scan_compositing import NumbaScanCompositing

    inputs, rays = [tensor.cpu() for tensor in (*met.gaussians, values)], met.rays.on_cpu
    until = torch.zeros_like(rays.azimuths) if met.until is None else met.until.cpu()
    composited = NumbaScanCompositing.apply(*inputs, rays.within, rays.elevations, until, rays.borders)
    return CompositedScan(*(tensor.to(values.device) for tensor in composited))
