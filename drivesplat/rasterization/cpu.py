"""The CPU rasterizer behind the door."""

import torch
from torch import Tensor

from drivesplat.kernels.numba.compositing import Compositing
from drivesplat.kernels.numba.harmonics import MAX_DEGREE, ViewColors
from drivesplat.kernels.numba.projection import Projection
from drivesplat.rasterization.rendering import Rendering, assembled


def rasterize_cpu(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, sh_degree: int | None, antialiased: bool, absgrad: bool, with_depth: bool,
) -> Rendering:  # fmt: skip
    """See `drivesplat.rasterization.rasterize`.

    Works in float32 and float64, in as many threads as torch, and gives the same bits however many these are. Gradients
    reach everything but `Ks`. Spherical harmonics go up to degree 3.
    """
    means2d, depths, conics, compensations, radii = Projection.apply(means, quats, scales, viewmats, Ks, width, height)
    opacities2d = opacities.expand(len(viewmats), -1)
    if antialiased:
        opacities2d = opacities2d * compensations
    if sh_degree is None:
        values = colors.expand(len(viewmats), -1, -1)
    else:
        if not 0 <= sh_degree <= MAX_DEGREE or colors.shape[1] < (sh_degree + 1) ** 2:
            raise ValueError(
                f"spherical harmonics of degree {sh_degree} from {colors.shape[1]} coefficients: "
                f"the CPU knows degrees 0 to {MAX_DEGREE}, and needs (degree + 1)² coefficients"
            )
        values = ViewColors.apply(means, colors, viewmats, radii, sh_degree)
    if with_depth:
        values = torch.cat([values, depths[..., None]], dim=-1)
    image, alpha = Compositing.apply(means2d, depths, conics, radii, opacities2d, values, width, height, absgrad)
    return assembled(
        image, alpha, with_depth, means2d=means2d, radii=radii, depths=depths, conics=conics, opacities=opacities2d
    )
