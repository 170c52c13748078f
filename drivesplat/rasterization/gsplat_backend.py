"""gsplat behind the door: the calls that its `rasterization` makes of one process, without its questions.

Camera positions are told by the poses' transposes, where `rasterization` inverts them and waits for the device. Where
Triton compiles, long lists of Gaussians are cut, so that no tile waits for the fullest one.
"""

import math
from typing import Any

import torch
from gsplat import fully_fused_projection, isect_offset_encode, isect_tiles, rasterize_to_pixels, spherical_harmonics
from torch import Tensor

from drivesplat.kernels import triton as on_gpu
from drivesplat.rasterization.rendering import Rendering, assembled

TILE = 16
"""Edge of a tile in pixels."""


def rasterize_gsplat(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, sh_degree: int | None, antialiased: bool, absgrad: bool, with_depth: bool,
) -> Rendering:  # fmt: skip
    """See `drivesplat.rasterization.rasterize`. Needs a GPU."""
    cameras = len(viewmats)
    if len(means) == 0:  # gsplat's kernels do not start on nothing
        shape = (cameras, height, width)
        values = colors.shape[-1] + with_depth
        return assembled(means.new_zeros(*shape, values), means.new_zeros(*shape, 1), with_depth)
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, width, height,
        calc_compensations=antialiased, opacities=opacities,
    )  # fmt: skip
    shown = opacities[None] if cameras == 1 else opacities.expand(cameras, -1)  # no sum over one in its gradient
    if compensations is not None:
        shown = shown * compensations
    values = colors[None] if cameras == 1 else colors.expand(cameras, *colors.shape)
    if sh_degree is not None:
        values = _seen_colors(means, values, viewmats, radii, sh_degree)
    if with_depth:
        values = torch.cat([values, depths[..., None]], dim=-1)
    seen = means2d, conics, values, shown
    composited, alpha = _composited(seen, radii, depths, width, height, absgrad)
    projected: dict[str, Any] = {"means2d": means2d, "radii": radii, "depths": depths, "conics": conics}
    return assembled(composited, alpha, with_depth, **projected, opacities=shown)


def _composited(
    seen: tuple[Tensor, Tensor, Tensor, Tensor], radii: Tensor, depths: Tensor, width: int, height: int, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Gaussians `seen` by c cameras, (means2d, conics, values, opacities), composited: by lists in chunks where Triton
    compiles, and by whole ones as gsplat does."""
    if not absgrad and on_gpu.for_tensor(seen[0]):
        from drivesplat.kernels.triton import chunks, tiles

        gaussians = tiles.Projected(*seen)
        if gaussians.values.shape[-1] <= chunks.MOST_VALUES:
            lists = tiles.lists_of(gaussians, radii, depths, width, height)
            return chunks.composited(gaussians, lists, width, height, rasterize_to_pixels)
    cameras, across, down = len(radii), math.ceil(width / TILE), math.ceil(height / TILE)
    _, isect_ids, flatten_ids = isect_tiles(seen[0], radii, depths, TILE, across, down, n_images=cameras)
    offsets = isect_offset_encode(isect_ids, cameras, across, down).reshape(cameras, down, across)
    return rasterize_to_pixels(*seen, width, height, TILE, offsets, flatten_ids, absgrad=absgrad)


def _seen_colors(means: Tensor, coefficients: Tensor, viewmats: Tensor, radii: Tensor, degree: int) -> Tensor:
    """The colours (c, n, 3) in which c cameras see Gaussians, of their harmonics (c, n, k, 3); of those that no camera
    sees there are none."""
    rotations, translations = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    positions = -(rotations.mT @ translations)[..., 0]
    seen = (radii > 0).all(dim=-1)
    colors = spherical_harmonics(degree, means - positions[:, None], coefficients, masks=seen)
    return torch.clamp_min(colors + 0.5, 0.0)
