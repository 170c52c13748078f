"""The colours of Gaussians in a view, as the rasterizer takes them."""

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.view_colors import fused_view_colors, view_colors
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.view import View


def rasterizer_colors(gaussians: Gaussians, view: View, sh_degree: int | None = None) -> tuple[Tensor, int | None]:
    """What the rasterizer is given: coefficients and their degree, at most `sh_degree`; or, where there is a kernel for
    it, the colours (n, 3) that the view's camera sees, and None."""
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    colors = fused_view_colors(gaussians.means, gaussians.sh0, gaussians.shN, view.camera_to_world, degree)
    return (gaussians.sh, degree) if colors is None else (colors, None)


def all_view_colors(gaussians: Gaussians, view: View) -> Float[Tensor, "n 3"]:
    """The colours that the view's camera would see of all Gaussians, also of those that are out of view."""
    colors, degree = rasterizer_colors(gaussians, view)
    if degree is None:
        return colors
    everywhere = torch.ones(1, len(gaussians), 2, dtype=torch.int32, device=colors.device)
    return view_colors(gaussians.means, colors, view.viewmat[None], everywhere, degree)[0]
