"""Sets of Gaussians projected into one camera, with their colors, ready to be composited."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.projection import ProjectedGaussians
from drivesplat.kernels.road_distance import ROUGHNESS, Road


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


class SetOnRoad(NamedTuple):
    """A `road`, and the `index` of the set whose Gaussians may belong to it."""

    index: int
    road: Road


class ProjectedWithColors(NamedTuple):
    """The n Gaussians of several sets, one set after the other, in the image of one camera: `gaussians`; the `values`
    to composite, RGB and, where it is wanted, depth in metres; the mean opacity and scale (metres) of all of them
    (`drivesplat.kernels.regularizers.mean_opacity_and_scale`); and the distance of one set from a road
    (`drivesplat.kernels.road_distance.road_distance`), None where it is not wanted. Of Gaussians out of view only the
    opacity and the radius, 0, are defined. Depth has a gradient in `values` alone."""

    gaussians: ProjectedGaussians
    values: Float[Tensor, "1 n v"]
    mean_opacity: Float[Tensor, ""]
    mean_scale: Float[Tensor, ""]
    road_distance: Float[Tensor, ""] | None = None


def project_with_colors(
    sets: Sequence[ColoredGaussians],
    camera: PinholeCamera,
    degrees: Sequence[int],
    with_depth: bool,
    on_road: SetOnRoad | None = None,
) -> ProjectedWithColors | None:
    """Projection, colors and means in one pass over each set, and their gradients in another, instead of several
    kernels and a copy of all sets. `degrees` are those up to which harmonics of each set are evaluated. The gradients
    of the distance from a road are added to the others where a Gaussian belongs to the road.

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
    options = size, tuple(degrees), with_depth, _road_options(on_road, sets)
    *projected, values, opacity, scale, distance = ColoredProjection.apply(
        *pose, *options, *(tensor for own in sets for tensor in own)
    )
    return ProjectedWithColors(ProjectedGaussians(*projected), values, opacity, scale, distance)


def _road_options(on_road: SetOnRoad | None, sets: Sequence[ColoredGaussians]) -> tuple[int, Road, float] | None:
    """The index of a set on a road, the road and its roughness; None where the road has no cell or the set is empty."""
    if on_road is None or not len(on_road.road.weights) or not len(sets[on_road.index].means):
        return None
    return on_road.index, on_road.road, ROUGHNESS
