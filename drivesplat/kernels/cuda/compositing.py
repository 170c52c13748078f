"""Alpha compositing of tiles' lists in chunks by CUDA C++ kernels, and its gradient.

They differ from gsplat's, which give the same images, in four ways. A warp skips Gaussians whose ellipse does not
reach its pixels. A thread has two pixels and adds their gradients. All gradients of a Gaussian are summed over a warp
together, in 16 shuffles, in place of five for each. The alpha of some of the Gaussians alone can be had beside the
image.

Chunks are composited at the same time, also those behind the end of a ray. The image does not show these, and their
gradients are skipped. So that little is composited in vain, blocks begin with the first chunks of all tiles, and leave
out pixels whose rays have ended in chunks that are already done. The image is the same whichever these are.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.composited import Composited
from drivesplat.kernels.cuda.compiled import IMAGES, IMAGES_WITH_OBJECTS, LENGTH, kernels
from drivesplat.kernels.cuda.tiles import PIXELS, WAVES
from drivesplat.kernels.triton.chunks import Chunks
from drivesplat.kernels.triton.joined_chunks import join
from drivesplat.kernels.triton.pixels import TILE
from drivesplat.kernels.triton.tiles import Footprints, TileLists

THREADS = TILE.value**2 // PIXELS


def composite(
    gaussians: Footprints,
    lists: TileLists,
    width: int,
    height: int,
    length: int = LENGTH,
    with_depth: bool = False,
    objects: slice | None = None,
) -> Composited:
    """As `drivesplat.kernels.triton.chunks.composite`, in chunks of at most `length` Gaussians. For one camera also the
    alpha of the Gaussians `objects` alone, without those behind the end of a ray."""
    chunks = Chunks.of(lists, length)
    values, alpha, past_objects = _ChunkImages.apply(*gaussians, lists, chunks, objects)
    past = None if objects is None else past_objects
    return join(values, alpha, chunks.firsts, lists.tiles, width, height, with_depth, past)


class _ChunkImages(torch.autograd.Function):
    """The values (m, 256, v), premultiplied by alpha, and alpha (m, 256), negative where the ray ends, of each of m
    chunks by itself, at the pixels of its tile, row by row; and the transmittance (m, 256) of the Gaussians `objects`
    alone, empty without them."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, conics: Tensor, values: Tensor, opacities: Tensor, lists: TileLists, chunks: Chunks,
        objects: slice | None,
    ) -> tuple[Float[Tensor, "m 256 v"], Float[Tensor, "m 256"], Float[Tensor, "m pixels"]]:  # fmt: skip
        given = [tensor.contiguous() for tensor in (means, conics, values, opacities)]
        pixels, (_, down, across) = (chunks.count, TILE.value**2), lists.tiles
        images, alphas = means.new_empty(*pixels, values.shape[-1]), means.new_empty(pixels)
        transmittances, lasts = means.new_empty(pixels), chunks.firsts.new_empty(pixels)
        past_objects = means.new_empty(chunks.count, 0 if objects is None else TILE.value**2)
        read = (*given, lists.ids, lists.order, lists.offsets, chunks.firsts, chunks.tile_of)
        own = (0, 0) if objects is None else (objects.start, objects.stop)
        ctx.chunks, ctx.sizes = chunks, (len(chunks.firsts) - 1, down * across, across, *own)
        ctx.program = IMAGES if objects is None else IMAGES_WITH_OBJECTS
        written = (images, alphas, transmittances, lasts, past_objects, lasts.new_zeros(chunks.count))
        blocks = chunks.count + (WAVES - 1) * ctx.sizes[0]
        _launch(ctx, "composite_chunks", blocks, values, *read, *written, *ctx.sizes)
        ctx.save_for_backward(*read, transmittances, lasts, past_objects)
        return images, alphas, past_objects

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        saved, values = ctx.saved_tensors, ctx.saved_tensors[2]
        summed = [torch.zeros_like(given) for given in saved[:4]]
        above = [gradient.contiguous() for gradient in gradients]
        _launch(ctx, "composite_chunks_backward", ctx.chunks.count, values, *saved, *above, *summed, *ctx.sizes)
        return *summed, None, None, None


def _launch(ctx: Any, kernel: str, blocks: int, values: Tensor, *arguments: Tensor | int) -> None:
    """Runs so many `blocks` of a kernel of `ctx.program`. The `values` (c, n, v) of its Gaussians have to be on the
    current device."""
    run = kernels(ctx.program, values.shape[-1], ctx.chunks.length, values.device.index)[kernel]
    run(blocks, THREADS, arguments)
