"""Alpha compositing of projected Gaussians, with gradients (Kerbl et al. 2023)."""

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba.layout import CHUNK, CONIC_XX, CONIC_XY, CONIC_YY, MOMENTS, OPACITY, NumbaTileLists
from drivesplat.kernels.numba.pixels import composite_tiles, composite_tiles_backward
from drivesplat.kernels.numba.projection import arrays
from drivesplat.kernels.numba.threads import parallel_for
from drivesplat.kernels.numba.tiles import Splats, front_to_back, grid, tile_lists


class Compositing(torch.autograd.Function):
    """Image (c, h, w, channels), premultiplied, and alpha (c, h, w, 1) of projected Gaussians.

    With `absgrad` the backward pass leaves the sums over pixels of the absolute gradients of `means2d` in
    `means2d.absgrad` (c, n, 2), as gsplat does.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Float[Tensor, "c n 2"],
        depths: Float[Tensor, "c n"],
        conics: Float[Tensor, "c n 3"],
        radii: Int[Tensor, "c n 2"],
        opacities: Float[Tensor, "c n"],
        values: Float[Tensor, "c n channels"],
        width: int,
        height: int,
        absgrad: bool,
    ) -> tuple[Float[Tensor, "c h w channels"], Float[Tensor, "c h w 1"]]:
        cameras, channels = values.shape[0], values.shape[-1]
        image = means2d.new_empty((cameras, height, width, channels))
        alpha = means2d.new_empty((cameras, height, width, 1))
        ctx.cameras = []
        for c in range(cameras):
            splats = front_to_back(*arrays(means2d[c], depths[c], conics[c], opacities[c], radii[c], values[c]))
            ctx.cameras.append(_composite(splats, *arrays(image[c], alpha[c])))
        ctx.save_for_backward(means2d, image, alpha)
        ctx.absgrad = absgrad
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, image, alpha = ctx.saved_tensors
        cameras, n = means2d.shape[:2]
        absolute = means2d.new_zeros((cameras, n if ctx.absgrad else 0, 2))
        v_inputs = [means2d.new_zeros((cameras, n, *size)) for size in ((2,), (3,), (), (image.shape[-1],))]
        for c in range(cameras):
            images = arrays(image[c], alpha[c], v_image[c], v_alpha[c])
            _composite_backward(*ctx.cameras[c], images, arrays(*(v[c] for v in (*v_inputs, absolute))), ctx.absgrad)
        if ctx.absgrad:
            means2d.absgrad = absolute
        v_means2d, v_conics, v_opacities, v_values = v_inputs
        return v_means2d, None, v_conics, None, v_opacities, v_values, None, None, None


def _composite(splats: Splats, image: np.ndarray, alpha: np.ndarray) -> tuple[Splats, NumbaTileLists | None]:
    """Renders one camera. Returns what its backward pass needs; the lists only where one window holds them all."""
    columns, rows = grid(image.shape[1], image.shape[0])
    lists = None
    for lists in tile_lists(splats, columns, rows):
        parallel_for(
            composite_tiles, lists.last - lists.first, CHUNK,
            lists.first, lists.offsets, lists.ranks, splats.shapes, splats.values, columns, image, alpha,
        )  # fmt: skip
    whole = lists is not None and lists.first == 0
    return splats, lists if whole else None


def _composite_backward(
    splats: Splats, lists: NumbaTileLists | None, images: list[np.ndarray], v_inputs: list[np.ndarray], absolute: bool
) -> None:
    """Adds one camera's gradients to `v_inputs`; `images` are image, alpha and their gradients."""
    columns, rows = grid(images[0].shape[1], images[0].shape[0])
    for window in [lists] if lists is not None else tile_lists(splats, columns, rows):
        width = MOMENTS + splats.values.shape[1] + 2 * absolute
        sums = np.zeros((len(window.ranks), width), splats.shapes.dtype)
        parallel_for(
            composite_tiles_backward, window.last - window.first, CHUNK,
            window.first, window.offsets, window.ranks, window.slots, splats.shapes, splats.values, columns,
            *images, absolute, sums,
        )  # fmt: skip
        parallel_for(
            _sum_entries, len(splats.order), 4096,
            splats.order, splats.shapes, window.slot_offsets, sums, *v_inputs,
        )  # fmt: skip


@kernel
@no_type_check
def _sum_entries(
    start, stop, order, shapes, slot_offsets, sums, v_means2d, v_conics, v_opacities, v_values, v_absolute
):
    """Adds the gradients of all entries of Gaussians `start` to `stop`, in the order of their tiles."""
    channels, width = v_values.shape[1], sums.shape[1]
    total = np.empty(width)
    for r in range(start, stop):
        total[:] = 0.0
        for slot in range(slot_offsets[r], slot_offsets[r + 1]):
            for k in range(width):
                total[k] += sums[slot, k]
        g, shape = order[r], shapes[r]
        v_opacities[g] += total[0] / shape[OPACITY]
        v_means2d[g, 0] += shape[CONIC_XX] * total[1] + shape[CONIC_XY] * total[2]
        v_means2d[g, 1] += shape[CONIC_XY] * total[1] + shape[CONIC_YY] * total[2]
        v_conics[g, 0] -= 0.5 * total[3]
        v_conics[g, 1] -= total[4]
        v_conics[g, 2] -= 0.5 * total[5]
        for k in range(channels):
            v_values[g, k] += total[MOMENTS + k]
        if width > MOMENTS + channels:
            v_absolute[g, 0] += total[MOMENTS + channels]
            v_absolute[g, 1] += total[MOMENTS + channels + 1]
