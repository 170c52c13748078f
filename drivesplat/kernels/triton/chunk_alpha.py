"""The alpha of an image from what the chunks of its tiles let through."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.chunks import Chunks
from drivesplat.kernels.triton.pixels import TILE, tile_pixels
from drivesplat.kernels.triton.tiles import TileLists


def alpha_of_chunks(
    transmittances: Float[Tensor, "m 256"],
    reached: Float[Tensor, "m 256"],
    chunks: Chunks,
    lists: TileLists,
    width: int,
    height: int,
) -> Float[Tensor, "c h w 1"]:
    """1 minus the product of the `transmittances` of a tile's chunks, which are those of its pixels, row by row. Chunks
    do not count where `reached` is 0."""
    return _ChunkAlpha.apply(transmittances, reached, chunks.firsts, lists.tiles, width, height)


class _ChunkAlpha(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, transmittances: Tensor, reached: Tensor, firsts: Tensor, tiles: tuple[int, int, int], width: int,
        height: int,
    ) -> Tensor:  # fmt: skip
        cameras, down, across = tiles
        transmittances = transmittances.contiguous()
        before, alpha = torch.empty_like(transmittances), transmittances.new_empty(cameras, height, width, 1)
        ctx.sizes = (width, height, across, down * across)
        _alpha[(cameras * down * across,)](transmittances, reached, firsts, before, alpha, *ctx.sizes)
        ctx.save_for_backward(transmittances, reached, firsts, before)
        return alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_alpha: Tensor) -> tuple[Tensor | None, ...]:
        transmittances, reached, firsts, before = ctx.saved_tensors
        v_transmittances = torch.empty_like(transmittances)
        v_alpha = v_alpha.contiguous()
        _alpha_backward[(len(firsts) - 1,)](
            transmittances, reached, firsts, before, v_alpha, v_transmittances, *ctx.sizes
        )
        return v_transmittances, None, None, None, None, None


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _alpha(transmittances, reached, firsts, before, alpha, width, height, across, per_camera):
    """Writes to `before` the product of all chunks in front of each one, and 0 where it is not reached."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    for chunk in range(tl.load(firsts + tile), tl.load(firsts + tile + 1)):
        own = chunk * TILE * TILE + tl.arange(0, TILE * TILE).to(tl.int64)
        counts = tl.load(reached + own) > 0.0
        tl.store(before + own, tl.where(counts, passes, 0.0))
        passes = tl.where(counts, passes * tl.load(transmittances + own), passes)
    tl.store(alpha + at, 1.0 - passes, mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _alpha_backward(
    transmittances, reached, firsts, before, v_alpha, v_transmittances, width, height, across, per_camera
):  # fmt: skip
    """Writes the gradients of a tile's chunks, from the last to the first."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    v_passes = -tl.load(v_alpha + at, mask=inside, other=0.0)
    first, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    for step in range(last - first):
        own = (last - 1 - step) * TILE * TILE + tl.arange(0, TILE * TILE).to(tl.int64)
        tl.store(v_transmittances + own, v_passes * tl.load(before + own))
        counts = tl.load(reached + own) > 0.0
        v_passes = tl.where(counts, v_passes * tl.load(transmittances + own), v_passes)
