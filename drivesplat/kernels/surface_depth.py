"""The depth of the surfaces that images show."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.projection import ProjectedGaussians
from drivesplat.kernels.quaternions import rotation_matrix


def depth_planes(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    gaussians: ProjectedGaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
) -> Float[Tensor, "c n 3"]:
    """Where rays meet n Gaussians, as planes over the images of c cameras: the depth at each Gaussian's centre (metres
    along the camera axis) and its slopes to the right and down (metres per pixel).

    A ray meets a Gaussian where its density is largest. With the affine projection of EWA splatting this is the mean
    depth under the condition of the pixel, a linear function of the pixel (Zhang et al. 2024, RaDe-GS, arXiv
    2406.01467): cov(depth, pixel) cov(pixel)⁻¹ is its slope. The plane of a flat Gaussian is the Gaussian's own.
    `gaussians` are the projected ones; the other arguments are those of `drivesplat.rasterization.rasterize`. Planes of
    Gaussians out of view are 0.
    """
    seen = (gaussians.radii > 0).all(dim=-1)
    depths = torch.where(seen, gaussians.depths, 1.0)
    rotations, turns = rotation_matrix(F.normalize(quats, dim=-1)), viewmats[:, :3, :3]
    along = torch.einsum("nij,ci->cnj", rotations, turns[:, 2]) * scales.square()
    with_depth = torch.einsum("cij,njk,cnk->cni", turns, rotations, along)  # covariance of camera axes with depth
    at = torch.einsum("cij,nj->cni", turns, means) + viewmats[:, None, :3, 3]
    size, focal = means.new_tensor([width, height]), Ks.diagonal(dim1=1, dim2=2)[:, None, :2]
    principal, margin = Ks[:, None, :2, 2], 0.15 * size / focal  # the limits of the projection's linearisation
    toward = (at[..., :2] / depths[..., None]).clamp(-principal / focal - margin, (size - principal) / focal + margin)
    with_pixel = focal / depths[..., None] * (with_depth[..., :2] - toward * with_depth[..., 2:])
    a, b, c = gaussians.conics.unbind(dim=-1)
    x, y = with_pixel.unbind(dim=-1)
    return torch.where(seen[..., None], torch.stack([depths, a * x + b * y, b * x + c * y], dim=-1), 0.0)


@torch.no_grad()
def surface_depth(
    gaussians: ProjectedGaussians, planes: Float[Tensor, "c n 3"], width: int, height: int
) -> Float[Tensor, "c h w"]:
    """The depth in metres at which rays have passed half of what they see: that of the Gaussian whose weight brings the
    sum of weights to half of the final alpha, on its plane (`depth_planes`). 0 where a ray meets nothing.

    Runs Triton on a GPU and numba elsewhere; where Triton does not compile, the Gaussians are copied to the CPU.
    """
    if triton_support.usable_for(planes):
        from drivesplat.kernels.triton import surface_depth as kernels
        from drivesplat.kernels.triton.tiles import Footprints, tile_lists

        footprints = Footprints(gaussians.means2d, gaussians.conics, planes, gaussians.opacities)
        lists = tile_lists(footprints, gaussians.radii, gaussians.depths, width, height)
        return kernels.surface_depth(footprints, lists, width, height)
    from drivesplat.kernels.numba.surface_depth import surface_depth as on_cpu

    cpu = [on_cpu(*(values[c].cpu() for values in (*gaussians, planes)), width, height) for c in range(len(planes))]
    return torch.stack(cpu).to(planes.device)
