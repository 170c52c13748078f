"""Gaussians and their colours in a view, as the rasterizer takes them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.colored_projection import (
    ColoredGaussians,
    PinholeCamera,
    ProjectedWithColors,
    project_with_colors,
)
from drivesplat.kernels.view_colors import fused_view_colors, view_colors
from drivesplat.model.gaussians import Gaussians, with_sh_degree
from drivesplat.model.view import View


def rasterizer_colors(sets: Sequence[Gaussians], view: View, sh_degree: int | None = None) -> tuple[Tensor, int | None]:
    """What the rasterizer is given of several sets, one after the other: coefficients and their degree, at most
    `sh_degree`; or, where there is a kernel for it, the colours (n, 3) that the view's camera sees, and None."""
    seen = [_fused(own, view, sh_degree) for own in sets]
    colors = [own for own in seen if own is not None]
    if len(colors) == len(sets):
        return torch.cat(colors) if len(colors) > 1 else colors[0], None
    highest = max(own.sh_degree for own in sets)
    coefficients = [with_sh_degree(own, highest).sh for own in sets]
    return torch.cat(coefficients) if len(sets) > 1 else coefficients[0], _up_to(highest, sh_degree)


def projected_sets(
    sets: Sequence[Gaussians], view: View, sh_degree: int | None = None, with_depth: bool = False
) -> ProjectedWithColors | None:
    """Several sets, one after the other, projected and with the colours that the view's camera sees, by harmonics up to
    `sh_degree`. None for a rolling shutter, and where there is no kernel for it
    (`drivesplat.kernels.colored_projection.project_with_colors`)."""
    if view.shutter is not None:
        return None
    given = [ColoredGaussians(own.means, own.quats, own.scales, own.opacities, own.sh0, own.shN) for own in sets]
    camera = PinholeCamera(view.viewmat, view.camera_to_world, view.K, view.width, view.height)
    degrees = [_up_to(own.sh_degree, sh_degree) for own in sets]
    return project_with_colors(given, camera, degrees, with_depth)


def all_view_colors(gaussians: Gaussians, view: View) -> Float[Tensor, "n 3"]:
    """The colours that the view's camera would see of all Gaussians, also of those that are out of view."""
    colors, degree = rasterizer_colors([gaussians], view)
    if degree is None:
        return colors
    everywhere = torch.ones(1, len(gaussians), 2, dtype=torch.int32, device=colors.device)
    return view_colors(gaussians.means, colors, view.viewmat[None], everywhere, degree)[0]


def _fused(own: Gaussians, view: View, sh_degree: int | None) -> Float[Tensor, "n 3"] | None:
    return fused_view_colors(own.means, own.sh0, own.shN, view.camera_to_world, _up_to(own.sh_degree, sh_degree))


def _up_to(degree: int, limit: int | None) -> int:
    return degree if limit is None else min(degree, limit)
