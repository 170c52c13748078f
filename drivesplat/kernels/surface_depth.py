"""The depth of the surfaces that images show."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.projection import ProjectedGaussians
from drivesplat.kernels.quaternions import rotation_matrix


@torch.no_grad()
def surface_depth(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    gaussians: ProjectedGaussians,
    alpha: Float[Tensor, "c h w"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
) -> Float[Tensor, "c h w"]:
    """The depth in metres at which rays have passed half of what they see: that of the Gaussian whose weight brings the
    sum of weights to half of `alpha`, on its plane (`depth_planes`). 0 where a ray meets nothing.

    `gaussians` are the projected ones and `alpha` is that of their image; the other arguments are those of
    `drivesplat.rasterization.rasterize`. Runs Triton on a GPU and numba elsewhere; where Triton does not compile, the
    Gaussians are copied to the CPU.
    """
    found = []
    for c, final in enumerate(alpha):
        rows = (gaussians.radii[c] > 0).all(dim=-1).nonzero().squeeze(1)
        seen = ProjectedGaussians(*(values[c].index_select(0, rows) for values in gaussians))
        shapes = (values.index_select(0, rows) for values in (means, quats, scales))
        planes = depth_planes(*shapes, seen.depths, seen.conics, viewmats[c], Ks[c], alpha.shape[2], alpha.shape[1])
        found.append(_of_camera(seen, planes, final) if len(rows) else torch.zeros_like(final))
    return torch.stack(found)


def _of_camera(
    gaussians: ProjectedGaussians, planes: Float[Tensor, "m 3"], alpha: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """The depth that one camera sees; `gaussians` are those in its view."""
    height, width = alpha.shape
    if triton_support.usable_for(planes):
        from drivesplat.kernels.triton import surface_depth as kernels
        from drivesplat.kernels.triton.tiles import Footprints, tile_lists

        means2d, depths, conics, radii, opacities = (values[None] for values in gaussians)
        footprints = Footprints(means2d, conics, planes[None], opacities)
        lists = tile_lists(footprints, radii, depths, width, height)
        return kernels.surface_depth(footprints, lists, alpha[None])[0]
    from drivesplat.kernels.numba.surface_depth import surface_depth as on_cpu

    return on_cpu(*(values.cpu() for values in (*gaussians, planes, alpha))).to(planes.device)


def depth_planes(
    means: Float[Tensor, "m 3"],
    quats: Float[Tensor, "m 4"],
    scales: Float[Tensor, "m 3"],
    depths: Float[Tensor, " m"],
    conics: Float[Tensor, "m 3"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
) -> Float[Tensor, "m 3"]:
    """Where rays meet the m Gaussians in view, as planes over the image: the depth at each Gaussian's centre (metres
    along the camera axis) and its slopes to the right and down (metres per pixel).

    A ray meets a Gaussian where its density is largest. With the affine projection of EWA splatting this is the mean
    depth under the condition of the pixel, a linear function of the pixel (Zhang et al. 2024, RaDe-GS, arXiv
    2406.01467): cov(depth, pixel) cov(pixel)⁻¹ is its slope. The plane of a flat Gaussian is the Gaussian's own.
    `depths` and `conics` are those of the projected Gaussians.
    """
    turn = viewmat[:3, :3]
    turned = turn @ rotation_matrix(F.normalize(quats, dim=-1))  # Gaussian to camera axes
    along = turned[:, 2] * scales.square()
    with_depth = (turned * along[:, None]).sum(dim=-1)  # covariance of camera axes with depth
    at = means @ turn.T + viewmat[:3, 3]
    size, focal, principal = means.new_tensor([width, height]), K.diagonal()[:2], K[:2, 2]
    margin = 0.15 * size / focal  # the limits of the projection's linearisation
    toward = (at[:, :2] / depths[:, None]).clamp(-principal / focal - margin, (size - principal) / focal + margin)
    with_pixel = focal / depths[:, None] * (with_depth[:, :2] - toward * with_depth[:, 2:])
    a, b, c = conics.unbind(dim=-1)
    x, y = with_pixel.unbind(dim=-1)
    return torch.stack([depths, a * x + b * y, b * x + c * y], dim=-1)
