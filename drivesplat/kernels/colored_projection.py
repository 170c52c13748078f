"""Sets of Gaussians projected into one camera, with their colors, ready to be composited."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.projection import ProjectedGaussians


class ColoredGaussians(NamedTuple):
    """n Gaussians in the world: `means` and `scales` in metres, `quats` (w, x, y, z) of any length, `opacities` in
    [0, 1], and spherical harmonics of RGB colors, `sh0` of degree 0 and `shN` of the degrees above."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    sh0: Float[Tensor, "n 1 3"]
    shN: Float[Tensor, "n k_less_1 3"]


class PinholeCamera(NamedTuple):
    """A pinhole camera in OpenCV axes: its pose in both directions (metres), `K` and the image size in pixels."""

    viewmat: Float[Tensor, "4 4"]
    camera_to_world: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int


class ProjectedWithColors(NamedTuple):
    """The n Gaussians of several sets, one set after the other, in the image of one camera: `gaussians`; and the
    `values` to composite, RGB and, where it is wanted, depth in metres. Of Gaussians out of view only the opacity and
    the radius, 0, are defined. Depth has a gradient in `values` alone."""

    gaussians: ProjectedGaussians
    values: Float[Tensor, "1 n v"]


def project_with_colors(
    sets: Sequence[ColoredGaussians], camera: PinholeCamera, degrees: Sequence[int], with_depth: bool
) -> ProjectedWithColors | None:
    """Projection and colors in one pass over each set, and their gradients in another, instead of several kernels and a
    copy of all sets. `degrees` are those up to which harmonics of each set are evaluated.

    Equals `drivesplat.kernels.projection.project` on a GPU without `antialiased`, and
    `drivesplat.kernels.view_colors.view_colors`. Returns None where the kernel does not apply; it needs Triton, degrees
    0 or 1, at least one Gaussian, and a camera without gradient. Raises ValueError for a set with fewer coefficients
    than its degree needs.
    """
    learned = camera.viewmat.requires_grad or camera.camera_to_world.requires_grad
    some = any(len(own.means) for own in sets)
    if learned or not some or max(degrees) > 1 or not triton_support.usable_for(camera.viewmat):
        return None
    for own, degree in zip(sets, degrees, strict=True):
        if own.shN.shape[1] + 1 < (degree + 1) ** 2:
            raise ValueError(f"spherical harmonics of degree {degree} from {own.shN.shape[1] + 1} coefficients")
    from drivesplat.kernels.triton.colored_projection import ColoredProjection

    pose, size = (camera.viewmat, camera.K, camera.camera_to_world), (camera.width, camera.height)
    *projected, values = ColoredProjection.apply(
        *pose, size, tuple(degrees), with_depth, *(tensor for own in sets for tensor in own)
    )
    return ProjectedWithColors(ProjectedGaussians(*projected), values)
