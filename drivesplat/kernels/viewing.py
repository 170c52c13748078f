"""Sets of Gaussians as one camera sees them, ready to be composited."""

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


class PinholeView(NamedTuple):
    """A pinhole camera in OpenCV axes, with its pose in both directions (metres), `K` and image size in pixels."""

    viewmat: Float[Tensor, "4 4"]
    camera_to_world: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int


class ViewedGaussians(NamedTuple):
    """All Gaussians of several sets, one set after the other, as one camera sees them: `gaussians` in the image, the
    `values` that are composited, RGB and, where it is wanted, depth in metres; and the mean opacity and scale (metres)
    of the sets (`drivesplat.kernels.regularizers.mean_opacity_and_scale`). Values are undefined out of view."""

    gaussians: ProjectedGaussians
    values: Float[Tensor, "1 n v"]
    mean_opacity: Float[Tensor, ""]
    mean_scale: Float[Tensor, ""]


def viewed(
    sets: Sequence[ColoredGaussians], view: PinholeView, degrees: Sequence[int], with_depth: bool
) -> ViewedGaussians | None:
    """Projection, colors and means in one pass over each set, and their gradients in another, instead of several
    kernels and a copy of all sets. `degrees` are those up to which harmonics of each set are evaluated.

    Equals `drivesplat.kernels.projection.project` without `antialiased` and
    `drivesplat.kernels.view_colors.view_colors`. Returns None where the kernel does not apply; it needs Triton, degrees
    0 or 1, at least one Gaussian, and a camera without gradient.
    """
    learned = view.viewmat.requires_grad or view.camera_to_world.requires_grad
    some = any(len(own.means) for own in sets)
    if learned or not some or max(degrees) > 1 or not triton_support.usable_for(view.viewmat):
        return None
    from drivesplat.kernels.triton.viewing import Viewing

    size, tensors = (view.width, view.height), (tensor for own in sets for tensor in own)
    found = Viewing.apply(view.viewmat, view.K, view.camera_to_world, size, tuple(degrees), with_depth, *tensors)
    *projected, values, mean_opacity, mean_scale = found
    return ViewedGaussians(ProjectedGaussians(*projected), values, mean_opacity, mean_scale)
