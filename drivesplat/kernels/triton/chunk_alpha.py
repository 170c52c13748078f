"""The alpha of an image from what the chunks of its tiles let through."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.chunks import Chunks, tile_pixels
from drivesplat.kernels.triton.tiles import TILE, TileLists


def alpha_of_chunks(
    transmittances: Float[Tensor, "m 256"], chunks: Chunks, lists: TileLists, width: int, height: int
) -> Float[Tensor, "c h w 1"]:
    """1 minus the product of the `transmittances` of a tile's chunks, which are those of its pixels, row by row."""
    return _ChunkAlpha.apply(transmittances, chunks.firsts, lists.tiles, width, height)


class _ChunkAlpha(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, transmittances: Tensor, firsts: Tensor, tiles: tuple[int, int, int], width: int, height: int
    ) -> Tensor:
        cameras, down, across = tiles
        transmittances = transmittances.contiguous()
        before, alpha = torch.empty_like(transmittances), transmittances.new_empty(cameras, height, width, 1)
        ctx.sizes = (width, height, across, down * across)
        _alpha[(cameras * down * across,)](transmittances, firsts, before, alpha, *ctx.sizes)
        ctx.save_for_backward(transmittances, firsts, before)
        return alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        transmittances, firsts, before = ctx.saved_tensors
        v_transmittances = torch.empty_like(transmittances)
        v_alpha = v_alpha.contiguous()
        _alpha_backward[(len(firsts) - 1,)](transmittances, firsts, before, v_alpha, v_transmittances, *ctx.sizes)
        return v_transmittances, None, None, None, None


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _alpha(transmittances, firsts, before, alpha, width, height, across, per_camera):
    """Writes to `before` the product of all chunks in front of each one."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    for chunk in range(tl.load(firsts + tile), tl.load(firsts + tile + 1)):
        own = chunk * TILE * TILE + tl.arange(0, TILE * TILE).to(tl.int64)
        tl.store(before + own, passes)
        passes *= tl.load(transmittances + own)
    tl.store(alpha + at, 1.0 - passes, mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _alpha_backward(transmittances, firsts, before, v_alpha, v_transmittances, width, height, across, per_camera):
    """Writes the gradients of a tile's chunks, from the last to the first."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    v_passes = -tl.load(v_alpha + at, mask=inside, other=0.0)
    first, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    for step in range(last - first):
        own = (last - 1 - step) * TILE * TILE + tl.arange(0, TILE * TILE).to(tl.int64)
        tl.store(v_transmittances + own, v_passes * tl.load(before + own))
        v_passes *= tl.load(transmittances + own)
