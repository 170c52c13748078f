"""Alpha compositing of projected Gaussians along the rays of a LiDAR scan, front to back by range."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.scan_borders import scan_borders
from drivesplat.kernels.scan_projection import ScannedGaussians, wrapped


class CompositedScan(NamedTuple):
    """Sums over the Gaussians of b beams and a firings, weighted with transmittance times alpha: `range_sum` of ranges
    in metres, `alpha` of 1, `values`, and `alpha_before` of those in front of `until`. `median_range`, without
    gradient, is the range at which transmittance falls to 0.5 or less, 0 where it does not."""

    range_sum: Float[Tensor, "b a"]
    alpha: Float[Tensor, "b a"]
    alpha_before: Float[Tensor, "b a"]
    values: Float[Tensor, "b a v"]
    median_range: Float[Tensor, "b a"]


def composite_scan(
    gaussians: ScannedGaussians,
    values: Float[Tensor, "n v"],
    azimuths: Float[Tensor, "b a"],
    elevations: Float[Tensor, "b a"],
    until: Float[Tensor, "b a"],
) -> CompositedScan:
    """Composites Gaussians along rays (radians), in numba on the CPU. Tensors on a GPU are copied there and back."""
    from drivesplat.kernels.numba.scan_compositing import ScanCompositing

    device = gaussians.means2d.device
    azimuths, elevations = wrapped(azimuths).cpu(), elevations.cpu()
    inputs = [tensor.cpu() for tensor in (*gaussians, values)]
    borders = scan_borders(azimuths, elevations)
    composited = ScanCompositing.apply(*inputs, azimuths, elevations, until.cpu(), borders)
    return CompositedScan(*(tensor.to(device) for tensor in composited))
