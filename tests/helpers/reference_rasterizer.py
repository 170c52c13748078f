"""A readable rasterizer in plain torch, with which the others are compared.

Projection and spherical harmonics are gsplat's own torch implementations; compositing follows Kerbl et al. 2023, with
gsplat's cut-offs: alpha at most 0.999, contributions under 1/255 dropped, a ray ends before its transmittance reaches
1e-4.
"""

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from drivesplat.kernels.composited import Composited, with_depth_apart
from drivesplat.rasterization.rasterization import Rendering, assembled

MAX_ALPHA = 0.999
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
TILE = 16
NEAR_PLANE = 0.01
EPS2D = 0.3
"""Variance in square pixels that gsplat's 2D filter adds."""


def rasterize_reference(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, sh_degree: int | None = None, antialiased: bool = False, with_depth: bool = False,
) -> Rendering:  # fmt: skip
    """As `drivesplat.rasterization.rasterize`, in float32 and float64; autograd gives every gradient but `absgrad`."""
    covars, _ = _quat_scale_to_covar_preci(quats, scales, compute_covar=True, compute_preci=False)
    projected = [_project(means, covars, viewmat, k, width, height) for viewmat, k in zip(viewmats, Ks, strict=True)]
    radii, means2d, depths, conics = (torch.stack(values) for values in zip(*projected, strict=True))
    opacities2d = opacities.expand(len(viewmats), -1)
    if antialiased:
        opacities2d = opacities2d * _compensation(conics)
    images, alphas = [], []
    for camera in range(len(viewmats)):
        values = _view_colors(means, colors, viewmats[camera], sh_degree)
        if with_depth:
            values = torch.cat([values, depths[camera, :, None]], dim=-1)
        image, alpha = _composite(
            means2d[camera], conics[camera], depths[camera], radii[camera], opacities2d[camera], values, width, height
        )
        images.append(image)
        alphas.append(alpha)
    image, alpha = torch.stack(images), torch.stack(alphas)
    composited = with_depth_apart(image, alpha) if with_depth else Composited(image, alpha)
    return assembled(composited, means2d=means2d, radii=radii, depths=depths, conics=conics, opacities=opacities2d)


def _project(means: Tensor, covars: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, ...]:
    """Radii (n, 2), means (n, 2), depths (n,) and conics (n, 3) of Gaussians in one image.

    Gaussians behind the near plane are replaced by a harmless one without gradient, and get radius 0.
    """
    in_front = means.detach() @ viewmat[2, :3] + viewmat[2, 3] > NEAR_PLANE
    before_camera = viewmat[:3, :3].T @ (torch.tensor([0.0, 0.0, 1.0]).to(means) - viewmat[:3, 3])
    safe = torch.where(in_front[:, None], means, before_camera)
    radii, means2d, depths, conics, _ = _fully_fused_projection(safe, covars, viewmat[None], K[None], width, height)
    return radii[0] * in_front[:, None], means2d[0], depths[0], conics[0]


def _compensation(conics: Tensor) -> Tensor:
    """The factor (..., n) by which the 2D filter lowers opacities, from `conics` (..., n, 3): Yu et al. 2024, eq. 7."""
    c, b, a = (conics / (conics[..., :1] * conics[..., 2:] - conics[..., 1:2] ** 2)).unbind(-1)
    unfiltered = (a - EPS2D) * (c - EPS2D) - b**2
    return torch.sqrt((unfiltered / (a * c - b**2)).clamp(min=1e-12))


def _view_colors(means: Tensor, colors: Tensor, viewmat: Tensor, sh_degree: int | None) -> Tensor:
    if sh_degree is None:
        return colors
    camera_center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    used = (sh_degree + 1) ** 2
    return (_spherical_harmonics(sh_degree, means - camera_center, colors[:, :used]) + 0.5).clamp(min=0.0)


def _composite(
    means2d: Tensor, conics: Tensor, depths: Tensor, radii: Tensor, opacities: Tensor, values: Tensor, width: int,
    height: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The image (h, w, channels) and alpha (h, w, 1) of one camera, tile by tile, Gaussians front to back."""
    order = torch.argsort(depths.detach())
    order = order[(radii[order] > 0).all(dim=-1)]
    low, high = (means2d - radii).detach(), (means2d + radii).detach()
    rows = []
    for y in range(0, height, TILE):
        row = []
        for x in range(0, width, TILE):
            tile_w, tile_h = min(TILE, width - x), min(TILE, height - y)
            first, last = torch.tensor([x, y]).to(low), torch.tensor([x + tile_w, y + tile_h]).to(low)
            members = order[((low[order] < last) & (high[order] > first)).all(dim=-1)]
            row.append(_composite_tile(means2d, conics, opacities, values, members, (x, y, tile_w, tile_h)))
        rows.append(torch.cat(row, dim=1))
    image = torch.cat(rows, dim=0)
    return image[..., :-1], image[..., -1:]


def _composite_tile(
    means2d: Tensor, conics: Tensor, opacities: Tensor, values: Tensor, members: Tensor, tile: tuple[int, int, int, int]
) -> Tensor:
    """Values and alpha (h, w, channels + 1) of one tile; `members` (m,) are its Gaussians, front to back."""
    x0, y0, tile_w, tile_h = tile
    y, x = torch.meshgrid(
        torch.arange(tile_h).to(means2d) + y0 + 0.5, torch.arange(tile_w).to(means2d) + x0 + 0.5, indexing="ij"
    )
    dx = x.reshape(-1, 1) - means2d[members, 0]
    dy = y.reshape(-1, 1) - means2d[members, 1]
    a, b, c = conics[members].unbind(-1)
    sigma = 0.5 * (a * dx**2 + c * dy**2) + b * dx * dy
    alpha = (opacities[members] * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    alpha = torch.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, torch.zeros_like(alpha))
    transmittance_after = torch.cumprod(1.0 - alpha, dim=-1)
    alpha = torch.where(transmittance_after > MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
    transmittance = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1.0 - alpha], dim=-1), dim=-1)
    weights = alpha * transmittance[:, :-1]
    composited = torch.cat([weights @ values[members], weights.sum(dim=-1, keepdim=True)], dim=-1)
    return composited.reshape(tile_h, tile_w, -1)
