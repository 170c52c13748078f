"""Alpha compositing of projected Gaussians, front to back (Kerbl et al. 2023)."""

import math

from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.composited import Composited, with_depth_apart
from drivesplat.kernels.projection import ProjectedGaussians

TILE = 16
"""Edge of gsplat's tiles in pixels."""


def composite(
    gaussians: ProjectedGaussians,
    values: Float[Tensor, "c n v"],
    width: int,
    height: int,
    absgrad: bool,
    objects: slice | None = None,
    with_depth: bool = False,
) -> Composited:
    """Images of the Gaussians' `values` and alpha. With `with_depth` the last of the values is depth.

    With `absgrad` the backward pass leaves the sums over pixels of the absolute gradients of `means2d` in
    `means2d.absgrad`. Runs gsplat on a GPU, numba elsewhere. Where Triton compiles, long lists of Gaussians are cut
    into chunks, so that no tile waits for the longest one; where torch compiles CUDA C++, too, kernels of this package
    composite the chunks. For one camera these also compute the alpha of the Gaussians `objects` alone, without those
    behind the end of a ray (`drivesplat.kernels.cuda.compositing.composite`).
    """
    means2d, depths, conics, radii, opacities = gaussians
    if not means2d.is_cuda:
        from drivesplat.kernels.numba.compositing import Compositing

        return _composited(Compositing.apply(*gaussians, values, width, height, absgrad), with_depth)
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

    if not absgrad and triton_support.usable_for(means2d):
        from drivesplat.kernels.cuda import compiled, compositing
        from drivesplat.kernels.triton import chunks, tiles

        if values.shape[-1] <= chunks.MAX_VALUES:
            footprints = tiles.Footprints(means2d, conics, values, opacities)
            lists = tiles.tile_lists(footprints, radii, depths, width, height)
            one_camera = objects is not None and len(radii) == 1
            alone = objects if one_camera and compiled.usable_for(values, compiled.IMAGES_WITH_OBJECTS) else None
            if alone is not None or compiled.usable_for(values, compiled.IMAGES):
                return compositing.composite(footprints, lists, width, height, with_depth=with_depth, objects=alone)
            return chunks.composite(footprints, lists, width, height, rasterize_to_pixels, with_depth)
    cameras, across, down = len(radii), math.ceil(width / TILE), math.ceil(height / TILE)
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, TILE, across, down, n_images=cameras)
    offsets = isect_offset_encode(isect_ids, cameras, across, down).reshape(cameras, down, across)
    whole = rasterize_to_pixels(
        means2d, conics, values, opacities, width, height, TILE, offsets, flatten_ids, absgrad=absgrad
    )
    return _composited(whole, with_depth)


def _composited(image_and_alpha: tuple[Tensor, Tensor], with_depth: bool) -> Composited:
    return with_depth_apart(*image_and_alpha) if with_depth else Composited(*image_and_alpha)
