"""Images of tiles' chunks composited front to back, and the gradient."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels import composited
from drivesplat.kernels.composited import Composited
from drivesplat.kernels.triton.pixels import TILE, tile_pixels

MIN_TRANSMITTANCE = tl.constexpr(1e-4)
"""Transmittance below which a ray ends, as in gsplat."""
MIN_ALPHA = tl.constexpr(composited.MIN_ALPHA)


def join(
    values: Float[Tensor, "m 256 v"],
    alpha: Float[Tensor, "m 256"],
    firsts: Int[Tensor, " t1"],
    tiles: tuple[int, int, int],
    width: int,
    height: int,
    with_depth: bool,
) -> tuple[Composited, Float[Tensor, "m 256"]]:
    """Images and alpha of all tiles, composited from those of their chunks, and the transmittance in front of each
    chunk. `firsts` are the first chunk of each of t tiles, then their number; `tiles` the numbers of cameras, rows and
    columns. A negative alpha ends the ray in its chunk, and so does a transmittance below 1e-4: chunks behind the end
    are not shown, and 0 is the transmittance in front of them. Gradients are those by the absolute alpha. With
    `with_depth` the last of the values is depth."""
    image, depth, whole, before = _Join.apply(values, alpha, firsts, tiles, width, height, with_depth)
    return Composited(image, whole, depth=depth if with_depth else None), before


class _Join(torch.autograd.Function):
    """`join`: images (c, h, w, v), depth (c, h, w, 1; empty without it), alpha (c, h, w, 1), and the transmittance in
    front of each chunk (m, 256)."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, alpha: Tensor, firsts: Tensor, tiles: tuple[int, int, int], width: int, height: int,
        with_depth: bool,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        cameras, down, across = tiles
        values, alpha, channels = values.contiguous(), alpha.contiguous(), values.shape[-1]
        before = torch.empty_like(alpha)
        image = values.new_empty(cameras, height, width, channels - with_depth)
        depth = values.new_empty(cameras, height, width, int(with_depth))
        whole = values.new_empty(cameras, height, width, 1)
        padded = triton.next_power_of_2(channels)
        ctx.sizes = (width, height, across, down * across, channels, padded, with_depth)
        _composite[(cameras * down * across,)](values, alpha, firsts, before, image, depth, whole, *ctx.sizes)
        ctx.save_for_backward(values, alpha, firsts, before, depth, whole)
        ctx.mark_non_differentiable(before)
        return image, depth, whole, before

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_depth: Tensor, v_whole: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        values, alpha, firsts, before, depth, whole = ctx.saved_tensors
        v_values, v_alpha = torch.empty_like(values), torch.empty_like(alpha)
        given = (v_image.contiguous(), v_depth.contiguous(), v_whole.contiguous())
        _composite_backward[(len(firsts) - 1,)](
            values, alpha, firsts, before, depth, whole, *given, v_values, v_alpha, *ctx.sizes
        )
        return v_values, v_alpha, None, None, None, None, None


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _composite(
    values, alpha, firsts, before, image, depth, whole, width, height, across, per_camera,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr,
):  # fmt: skip
    """Composites a tile of the image; writes to `before` the transmittance in front of each of its chunks, 0 behind the
    end of a ray."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    pixel, channel = tl.arange(0, TILE * TILE).to(tl.int64), tl.arange(0, WIDTH)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    goes_on = tl.full((TILE * TILE,), 1, tl.int1)
    total = tl.zeros((TILE * TILE, WIDTH), tl.float32)
    for chunk in range(tl.load(firsts + tile), tl.load(firsts + tile + 1)):
        own = chunk * TILE * TILE + pixel
        reaches, found = tl.where(goes_on, passes, 0.0), tl.load(alpha + own)
        tl.store(before + own, reaches)
        shown = tl.load(values + own[:, None] * CHANNELS + channel, mask=(channel < CHANNELS)[None, :], other=0.0)
        total += reaches[:, None] * shown
        passes = tl.where(goes_on, passes * (1.0 - tl.abs(found)), passes)
        goes_on &= (found >= 0.0) & (passes > MIN_TRANSMITTANCE)
    tl.store(whole + at, 1.0 - passes, mask=inside)
    colors = inside[:, None] & (channel < CHANNELS - DEPTH)[None, :]
    tl.store(image + at[:, None] * (CHANNELS - DEPTH) + channel, total, mask=colors)
    if DEPTH:
        depth_sum = tl.sum(tl.where((channel == CHANNELS - 1)[None, :], total, 0.0), 1)
        tl.store(depth + at, depth_sum / tl.maximum(1.0 - passes, MIN_ALPHA), mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _composite_backward(
    values, alpha, firsts, before, depth, whole, v_image, v_depth, v_whole, v_values, v_alpha,
    width, height, across, per_camera, CHANNELS: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr,
):  # fmt: skip
    """Writes the gradients of a tile's chunks, from the last to the first."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    pixel, channel = tl.arange(0, TILE * TILE).to(tl.int64), tl.arange(0, WIDTH)
    valid, colors = (channel < CHANNELS)[None, :], inside[:, None] & (channel < CHANNELS - DEPTH)[None, :]
    v_pixel = tl.load(v_image + at[:, None] * (CHANNELS - DEPTH) + channel, mask=colors, other=0.0)
    v_pixel_alpha = tl.load(v_whole + at, mask=inside, other=0.0)
    if DEPTH:
        total = tl.load(whole + at, mask=inside, other=1.0)
        v_sum = tl.load(v_depth + at, mask=inside, other=0.0) / tl.maximum(total, MIN_ALPHA)
        v_pixel += tl.where((channel == CHANNELS - 1)[None, :], v_sum[:, None], 0.0)
        v_pixel_alpha -= tl.where(total >= MIN_ALPHA, v_sum * tl.load(depth + at, mask=inside, other=0.0), 0.0)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    behind = tl.zeros((TILE * TILE, WIDTH), tl.float32)
    first, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    for step in range(last - first):
        own = (last - 1 - step) * TILE * TILE + pixel
        reaches, left = tl.load(before + own), 1.0 - tl.abs(tl.load(alpha + own))
        tl.store(v_values + own[:, None] * CHANNELS + channel, reaches[:, None] * v_pixel, mask=valid)
        tl.store(v_alpha + own, reaches * (v_pixel_alpha * passes - tl.sum(v_pixel * behind, 1)))
        shown = tl.load(values + own[:, None] * CHANNELS + channel, mask=valid, other=0.0)
        behind = tl.where(reaches[:, None] > 0.0, shown + left[:, None] * behind, 0.0)
        passes = tl.where(reaches > 0.0, passes * left, 1.0)
