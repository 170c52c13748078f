"""The rasterization call, with the meaning of gsplat's, on GPU and CPU, and its result."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.colored_projection import ProjectedWithColors
from drivesplat.kernels.composited import Composited
from drivesplat.kernels.compositing import composite
from drivesplat.kernels.projection import project
from drivesplat.kernels.surface_depth import surface_depth
from drivesplat.kernels.view_colors import view_colors


@dataclass(frozen=True)
class Rendering:
    """The images of c cameras.

    `image` is premultiplied by `alpha`: nothing is composited behind it. `depth` is the expected depth in metres along
    the camera axis, or None. `info` holds what gsplat's strategies read: `means2d`, `radii`, `depths`, `conics`,
    `opacities`, `width`, `height`, `n_cameras` and `gaussian_ids`. `objects_alpha` is the alpha of the
    Gaussians `objects` alone, None where it needs a second rendering. Opaque Gaussians before an object may hide it.
    `surface_depth` is the depth of surfaces in metres along the camera axis, 0 where a ray meets no Gaussian; or None.
    """

    image: Float[Tensor, "c h w channels"]
    alpha: Float[Tensor, "c h w 1"]
    depth: Float[Tensor, "c h w 1"] | None
    info: dict[str, Any]
    objects_alpha: Float[Tensor, "c h w 1"] | None = None
    surface_depth: Float[Tensor, "c h w"] | None = None


def rasterize(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n channels"] | Float[Tensor, "n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    antialiased: bool = False,
    absgrad: bool = False,
    with_depth: bool = False,
    objects: slice | None = None,
    with_surface_depth: bool = False,
) -> Rendering:
    """Renders n 3D Gaussians in c pinhole cameras.

    The projection is EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023). Tensors on a
    GPU are rendered by gsplat and Triton in float32, others by numba in float32 or float64, in as many threads as torch
    uses and with results that do not depend on their number. Gradients reach all tensors but `Ks`.

    There are two depths. The expected depth is the mean depth of Gaussians' centres. It has a gradient, but lies behind
    a surface where a little of what is far behind it shows through. The depth of surfaces is that at which a ray has
    passed half of what it sees: half of the final alpha. Up to there it follows the planes of the Gaussians, on which
    rays meet them where they are densest (RaDe-GS: Zhang et al. 2024, arXiv 2406.01467). It has no gradient.

    Args:
        means: Centres in world coordinates, metres.
        quats: Rotations, Gaussian to world, as w, x, y, z of any length.
        scales: Standard deviations along the Gaussian's axes, metres.
        opacities: In [0, 1].
        colors: Values of each channel, or spherical harmonics with k >= (sh_degree + 1)² coefficients.
        viewmats: World to camera, metres, in OpenCV axes: x right, y down, z forward.
        Ks: Intrinsics in pixels; the centre of the first pixel is at (0.5, 0.5).
        width: Image width in pixels.
        height: Image height in pixels.
        sh_degree: Degree up to which harmonics are evaluated, at most 3 on a CPU; None: `colors` are final values.
        antialiased: Scale opacities by the area that the 2D filter adds (Yu et al. 2024).
        absgrad: Let the backward pass write `info["means2d"].absgrad` (c, n, 2), as gsplat's strategies need it.
        with_depth: Also render the expected depth.
        objects: Rows of Gaussians. Their alpha alone is computed, too, where this needs no second rendering.
        with_surface_depth: Also compute the depth of surfaces.

    Returns:
        A `Rendering`: image (c, h, w, channels), premultiplied by alpha; alpha (c, h, w, 1); depth (c, h, w, 1) in
        metres or None; info for gsplat's strategies; the alpha of `objects` (c, h, w, 1) or None; the depth of surfaces
        (c, h, w) in metres or None.

    Raises:
        ValueError: On a CPU, for an `sh_degree` above 3 or too few coefficients.

    Example:
        One red Gaussian two metres in front of a camera at the origin.

        >>> import torch
        >>> from drivesplat.rasterization import rasterize
        >>> means = torch.tensor([[0.0, 0.0, 2.0]])
        >>> quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> scales = torch.full((1, 3), 0.1)
        >>> opacities, colors = torch.tensor([0.8]), torch.tensor([[1.0, 0.0, 0.0]])
        >>> viewmats = torch.eye(4)[None]
        >>> Ks = torch.tensor([[[50.0, 0.0, 16.5], [0.0, 50.0, 12.5], [0.0, 0.0, 1.0]]])
        >>> rendering = rasterize(means, quats, scales, opacities, colors, viewmats, Ks, 32, 24, with_depth=True)
        >>> tuple(rendering.image.shape), tuple(rendering.alpha.shape)
        ((1, 24, 32, 3), (1, 24, 32, 1))
        >>> rendering.image[0, 12, 16].tolist() == [rendering.alpha[0, 12, 16].item(), 0.0, 0.0]
        True
        >>> round(rendering.alpha[0, 12, 16].item(), 3), round(rendering.depth[0, 12, 16].item(), 3)
        (0.8, 2.0)

        A flat one at the same place, turned by 45 degrees about the vertical, before a transparent one: the depth of
        surfaces at the centre of the image, and 4 pixels to the right.

        >>> import math
        >>> means = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 20.0]])
        >>> turned = [math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0]
        >>> quats = torch.tensor([turned, [1.0, 0.0, 0.0, 0.0]])
        >>> scales = torch.tensor([[1.0, 1.0, 0.01], [1.0, 1.0, 1.0]])
        >>> opacities, colors = torch.tensor([0.9, 0.1]), torch.ones(2, 1)
        >>> shapes = (means, quats, scales, opacities)
        >>> depth = rasterize(*shapes, colors, viewmats, Ks, 32, 24, with_surface_depth=True).surface_depth
        >>> tuple(depth.shape), round(depth[0, 12, 16].item(), 2), round(depth[0, 12, 20].item(), 2)
        ((1, 24, 32), 2.0, 1.84)
    """
    cameras = len(viewmats)
    if means.is_cuda and len(means) == 0:  # gsplat's kernels need at least one Gaussian
        size = (cameras, height, width)
        image, alpha = means.new_zeros(*size, colors.shape[-1]), means.new_zeros(*size, 1)
        empty = Composited(image, alpha, depth=torch.zeros_like(alpha) if with_depth else None)
        return assembled(empty, means.new_zeros(size) if with_surface_depth else None)
    gaussians = project(means, quats, scales, opacities, viewmats, Ks, width, height, antialiased)
    if sh_degree is not None:
        values = view_colors(means, colors, viewmats, gaussians.radii, sh_degree)
    else:
        values = colors[None] if cameras == 1 else colors.expand(cameras, -1, -1)
    if with_depth:
        values = torch.cat([values, gaussians.depths[..., None]], dim=-1)
    composited = composite(gaussians, values, width, height, absgrad, objects, with_depth)
    surfaces = None
    if with_surface_depth:
        surfaces = surface_depth(means, quats, scales, gaussians, composited.alpha.squeeze(-1), viewmats, Ks)
    return assembled(composited, surfaces, **gaussians._asdict())


def rasterize_projected(
    projected: ProjectedWithColors,
    width: int,
    height: int,
    *,
    absgrad: bool = False,
    with_depth: bool = False,
    objects: slice | None = None,
) -> Rendering:
    """Renders Gaussians that are projected already; arguments and result as of `rasterize`, without the depth of
    surfaces. With `with_depth` the last of the values is depth; the depths in `info` have no gradient."""
    gaussians, values = projected.gaussians, projected.values
    composited = composite(gaussians, values, width, height, absgrad, objects, with_depth)
    return assembled(composited, **gaussians._asdict())


def assembled(
    composited: Composited, surface_depth: Float[Tensor, "c h w"] | None = None, **projected: Any
) -> Rendering:
    """A Rendering of composited values. `projected` are the Gaussians in the images: means2d, radii, depths, conics,
    opacities."""
    cameras, height, width = composited.alpha.shape[:3]
    info = {**projected, "width": width, "height": height, "n_cameras": cameras, "gaussian_ids": None}
    image, alpha, alone, depth = composited
    return Rendering(image, alpha, depth, info, alone, surface_depth)
