"""What sensors see of Gaussians by the direction towards them: colors from spherical harmonics, and for a LiDAR
intensity and the probability of a return."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels import triton_support


def view_colors(
    means: Float[Tensor, "n 3"],
    coefficients: Float[Tensor, "n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    radii: Int[Tensor, "c n 2"],
    degree: int,
) -> Float[Tensor, "c n 3"]:
    """Harmonics up to `degree` along the world directions from each camera to `means`, plus 0.5, at least 0. Runs
    gsplat's kernel on a GPU and numba elsewhere.

    `viewmats` map world to camera (OpenCV). Gaussians with radius 0 are out of view and have undefined colors. Raises
    ValueError for too few coefficients, and on the CPU for degrees above 3.
    """
    if not means.is_cuda:
        from drivesplat.kernels.numba.view_colors import MAX_DEGREE, NumbaViewColors

        if not 0 <= degree <= MAX_DEGREE or coefficients.shape[1] < (degree + 1) ** 2:
            raise ValueError(
                f"spherical harmonics of degree {degree} from {coefficients.shape[1]} coefficients: "
                f"the CPU knows degrees 0 to {MAX_DEGREE}, and needs (degree + 1)² coefficients"
            )
        return NumbaViewColors.apply(means, coefficients, viewmats, radii, degree)
    from gsplat import spherical_harmonics

    rotations, translations = viewmats[:, :3, :3], viewmats[:, :3, 3:]
    positions = -(rotations.mT @ translations)[..., 0]  # inverting viewmats would wait for the device
    cameras, in_view = len(viewmats), (radii > 0).all(dim=-1)
    expanded = coefficients[None] if cameras == 1 else coefficients.expand(cameras, -1, -1, -1)
    colors = spherical_harmonics(degree, means - positions[:, None], expanded, masks=in_view)
    return torch.clamp_min(colors + 0.5, 0.0)


def fused_view_colors(
    means: Float[Tensor, "n 3"],
    sh0: Float[Tensor, "n 1 3"],
    shN: Float[Tensor, "n k_less_1 3"],
    camera_to_world: Float[Tensor, "4 4"],
    degree: int,
) -> Float[Tensor, "n 3"] | None:
    """`view_colors` for one camera and all Gaussians, in one pass, without concatenating `sh0` and `shN`. Returns None
    where the kernel does not apply; it needs Triton, degree 0 or 1 and a camera without gradient."""
    if degree > 1 or camera_to_world.requires_grad or not triton_support.usable_for(means):
        return None
    from drivesplat.kernels.triton.view_colors import TritonViewColors

    return TritonViewColors.apply(means, sh0, shN, camera_to_world, degree)


def lidar_response(
    logits: Float[Tensor, "n 4 2"], means: Float[Tensor, "n 3"], sensor: Float[Tensor, "3"]
) -> Float[Tensor, "n 2"]:
    """Intensity and the probability of a return, both in [0, 1], of n Gaussians at `means` for a LiDAR at `sensor`
    (metres, world coordinates): the sigmoids of logits[:, 0] + direction @ logits[:, 1:], with the unit vector from the
    sensor to the Gaussian. Gradients reach `logits` alone."""
    if triton_support.usable_for(logits) and logits.dtype == torch.float32:
        from drivesplat.kernels.triton.lidar_response import LidarResponse

        return LidarResponse.apply(logits, means.detach(), sensor.detach())
    toward = normalize(means.detach() - sensor, dim=-1)
    along = (toward[:, :, None] * logits[:, 1:]).sum(dim=1)  # a GPU multiplies small matrices slowly
    return torch.sigmoid(logits[:, 0] + along)
