"""EWA projection of Gaussians into pinhole cameras (Zwicker et al. 2001; Kerbl et al. 2023)."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class ProjectedGaussians(NamedTuple):
    """n Gaussians as c cameras see them: `means2d` and `radii` in pixels, `depths` in metres along the camera axis,
    `conics`, the upper triangles of inverse 2D covariances, and `opacities`. Radii are 0 out of view."""

    means2d: Float[Tensor, "c n 2"]
    depths: Float[Tensor, "c n"]
    conics: Float[Tensor, "c n 3"]
    radii: Int[Tensor, "c n 2"]
    opacities: Float[Tensor, "c n"]


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    antialiased: bool,
) -> ProjectedGaussians:
    """Projects Gaussians, world to image; arguments as for `drivesplat.rasterization.rasterize`. Runs gsplat's kernel
    on a GPU and numba elsewhere."""
    if means.is_cuda:
        from gsplat import fully_fused_projection

        radii, means2d, depths, conics, compensations = fully_fused_projection(
            means, None, quats, scales, viewmats, Ks, width, height,
            calc_compensations=antialiased, opacities=opacities,
        )  # fmt: skip
    else:
        from drivesplat.kernels.numba.projection import Projection

        projected = Projection.apply(means, quats, scales, viewmats, Ks, width, height)
        means2d, depths, conics, compensations, radii = projected
    cameras = len(viewmats)
    opacities2d = opacities[None] if cameras == 1 else opacities.expand(cameras, -1)  # no sum over one in its gradient
    if antialiased:
        opacities2d = opacities2d * compensations
    return ProjectedGaussians(means2d, depths, conics, radii, opacities2d)
