"""Alpha compositing of tiles' lists in chunks by CUDA C++ kernels, and its gradient.

They differ from gsplat's, which give the same images, in three ways. A warp skips Gaussians whose ellipse does not
reach its pixels. A thread has two pixels and adds their gradients. All gradients of a Gaussian are summed over a warp
together, in 16 shuffles, in place of five for each.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cuda.compiled import IMAGES, LENGTH, kernels
from drivesplat.kernels.cuda.source import PIXELS
from drivesplat.kernels.triton.chunks import Chunks, join
from drivesplat.kernels.triton.tiles import TILE, Footprints, TileLists

THREADS = TILE.value**2 // PIXELS


def composite(
    gaussians: Footprints, lists: TileLists, width: int, height: int, length: int = LENGTH
) -> tuple[Float[Tensor, "c h w v"], Float[Tensor, "c h w 1"]]:
    """Images of values, premultiplied by alpha, and alpha, as `drivesplat.kernels.triton.chunks.composite`, in chunks
    of at most `length` Gaussians."""
    chunks = Chunks.of(lists, length)
    values, alpha = _ChunkImages.apply(*gaussians, lists, chunks)
    return join(values, alpha, chunks, lists, width, height)


class _ChunkImages(torch.autograd.Function):
    """The values (m, 256, v), premultiplied by alpha, and alpha (m, 256) of each of m chunks by itself, at the pixels
    of its tile, row by row."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, conics: Tensor, values: Tensor, opacities: Tensor, lists: TileLists, chunks: Chunks
    ) -> tuple[Float[Tensor, "m 256 v"], Float[Tensor, "m 256"]]:
        given = [tensor.contiguous() for tensor in (means, conics, values, opacities)]
        pixels, (_, down, across) = (chunks.count, TILE.value**2), lists.tiles
        images, alphas = means.new_empty(*pixels, values.shape[-1]), means.new_empty(pixels)
        transmittances, lasts = means.new_empty(pixels), chunks.firsts.new_empty(pixels)
        read = (*given, lists.ids, lists.order, lists.offsets, chunks.firsts, chunks.tile_of)
        ctx.chunks, ctx.sizes = chunks, (len(chunks.firsts) - 1, down * across, across)
        _launch("composite_chunks", chunks, values, *read, images, alphas, transmittances, lasts, *ctx.sizes)
        ctx.save_for_backward(*read, transmittances, lasts)
        return images, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_images: Tensor, v_alphas: Tensor) -> tuple[Tensor | None, ...]:
        saved, values = ctx.saved_tensors, ctx.saved_tensors[2]
        summed = [torch.zeros_like(given) for given in saved[:4]]
        above = (v_images.contiguous(), v_alphas.contiguous())
        _launch("composite_chunks_backward", ctx.chunks, values, *saved, *above, *summed, *ctx.sizes)
        return *summed, None, None


def _launch(kernel: str, chunks: Chunks, values: Tensor, *arguments: Tensor | int) -> None:
    """Runs a kernel for the chunks of Gaussians with `values` (c, n, v), which have to be on the current device."""
    run = kernels(IMAGES, values.shape[-1], chunks.length, values.device.index)[kernel]
    run(chunks.count, THREADS, arguments)
