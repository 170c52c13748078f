"""The depth of the surfaces that Gaussians show in pinhole cameras, on GPU and CPU."""

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import surface_depth
from drivesplat.kernels.projection import project


@torch.no_grad()
def rasterize_surface_depth(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    *,
    antialiased: bool = False,
) -> Float[Tensor, "c h w"]:
    """The depth of the surfaces that n 3D Gaussians show in c pinhole cameras, in metres along the camera axis.

    It is the depth at which a ray has passed half of what it sees: half of the final alpha. Up to there it follows the
    planes of the Gaussians, on which rays meet them where they are densest (RaDe-GS: Zhang et al. 2024, arXiv
    2406.01467). The expected depth of `rasterize` is the mean depth of Gaussians' centres instead: it has a gradient,
    but lies behind a surface where a little of what is far behind it shows through. No gradients.

    Args:
        means: Centres in world coordinates, metres.
        quats: Rotations, Gaussian to world, as w, x, y, z of any length.
        scales: Standard deviations along the Gaussian's axes, metres.
        opacities: In [0, 1].
        viewmats: World to camera, metres, in OpenCV axes: x right, y down, z forward.
        Ks: Intrinsics in pixels; the centre of the first pixel is at (0.5, 0.5).
        width: Image width in pixels.
        height: Image height in pixels.
        antialiased: Scale opacities by the area that the 2D filter adds (Yu et al. 2024).

    Returns:
        Depth (c, h, w) in metres; 0 where a ray meets no Gaussian.

    Example:
        A flat Gaussian two metres before a camera at the origin, turned by 45 degrees about the vertical, before a
        transparent one: at the centre of the image, and 4 pixels to the right.

        >>> import math
        >>> import torch
        >>> from drivesplat.rasterization import rasterize_surface_depth
        >>> means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 20.0]])
        >>> turned = [math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0]
        >>> quats = torch.tensor([turned, [1.0, 0.0, 0.0, 0.0]])
        >>> scales = torch.tensor([[1.0, 1.0, 0.01], [1.0, 1.0, 1.0]])
        >>> opacities = torch.tensor([0.9, 0.1])
        >>> viewmats = torch.eye(4)[None]
        >>> Ks = torch.tensor([[[50.0, 0.0, 16.5], [0.0, 50.0, 12.5], [0.0, 0.0, 1.0]]])
        >>> depth = rasterize_surface_depth(means, quats, scales, opacities, viewmats, Ks, 32, 24)
        >>> tuple(depth.shape), round(depth[0, 12, 16].item(), 2), round(depth[0, 12, 20].item(), 2)
        ((1, 24, 32), 2.0, 1.84)
    """
    if len(means) == 0:
        return means.new_zeros(len(viewmats), height, width)
    gaussians = project(means, quats, scales, opacities, viewmats, Ks, width, height, antialiased)
    planes = surface_depth.depth_planes(means, quats, scales, gaussians, viewmats, Ks, width, height)
    return surface_depth.surface_depth(gaussians, planes, width, height)
