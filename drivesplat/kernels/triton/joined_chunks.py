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
    past_objects: Float[Tensor, "m 256"] | None = None,
) -> Composited:
    """Images and alpha of all tiles, composited from those of their chunks. `firsts` are the first chunk of each of t
    tiles, then their number; `tiles` the numbers of cameras, rows and columns. A negative alpha ends the ray in its
    chunk, and so does a transmittance below 1e-4: chunks behind the end are not shown. Gradients are those by the
    absolute alpha. With `with_depth` the last of the values is depth. `past_objects` is the transmittance of each chunk
    through some of its Gaussians alone, those of objects; with it the alpha of the objects is returned, too."""
    past = alpha.new_empty(0) if past_objects is None else past_objects
    image, depth, whole, objects_alpha = _Join.apply(values, alpha, past, firsts, tiles, width, height, with_depth)
    return Composited(image, whole, None if past_objects is None else objects_alpha, depth if with_depth else None)


class _Join(torch.autograd.Function):
    """`join`: images (c, h, w, v), depth (c, h, w, 1; empty without it), alpha (c, h, w, 1), and that of objects (c, h,
    w, 1; empty without a transmittance `past_objects`)."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, alpha: Tensor, past_objects: Tensor, firsts: Tensor, tiles: tuple[int, int, int],
        width: int, height: int, with_depth: bool,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        cameras, down, across = tiles
        with_objects = past_objects.numel() > 0
        values, alpha, past_objects = values.contiguous(), alpha.contiguous(), past_objects.contiguous()
        before, past_before = torch.empty_like(alpha), torch.empty_like(past_objects)
        channels, size = values.shape[-1], (cameras, height, width)
        image, depth = values.new_empty(*size, channels - with_depth), values.new_empty(*size, int(with_depth))
        whole, objects_alpha = values.new_empty(*size, 1), values.new_empty(*size, int(with_objects))
        padded = triton.next_power_of_2(channels)
        ctx.sizes = (width, height, across, down * across, channels, padded, with_depth, with_objects)
        given, written = (values, alpha, past_objects, firsts), (before, past_before)
        images = (image, depth, whole, objects_alpha)
        _composite[(cameras * down * across,)](*given, *written, *images, *ctx.sizes)
        ctx.save_for_backward(*given, *written, depth, whole)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        values, alpha, past_objects, firsts, *others = ctx.saved_tensors
        summed = torch.empty_like(values), torch.empty_like(alpha), torch.empty_like(past_objects)
        above = (gradient.contiguous() for gradient in gradients)
        _composite_backward[(len(firsts) - 1,)](
            values, alpha, past_objects, firsts, *others, *above, *summed, *ctx.sizes
        )
        return *summed, None, None, None, None, None


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _composite(
    values, alpha, past_objects, firsts, before, past_before, image, depth, whole, objects_alpha,
    width, height, across, per_camera,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, OBJECTS: tl.constexpr,
):  # fmt: skip
    """Composites a tile of the image; writes to `before` the transmittance in front of each of its chunks, 0 behind the
    end of a ray, and to `past_before` that of the objects in front of it."""
    tile = tl.program_id(0)
    at, inside = tile_pixels(tile, width, height, across, per_camera)
    pixel, channel = tl.arange(0, TILE * TILE).to(tl.int64), tl.arange(0, WIDTH)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    past = tl.full((TILE * TILE,), 1.0, tl.float32)
    goes_on = tl.full((TILE * TILE,), 1, tl.int1)
    total = tl.zeros((TILE * TILE, WIDTH), tl.float32)
    for chunk in range(tl.load(firsts + tile), tl.load(firsts + tile + 1)):
        own = chunk * TILE * TILE + pixel
        reaches, found = tl.where(goes_on, passes, 0.0), tl.load(alpha + own)
        tl.store(before + own, reaches)
        shown = tl.load(values + own[:, None] * CHANNELS + channel, mask=(channel < CHANNELS)[None, :], other=0.0)
        total += reaches[:, None] * shown
        passes = tl.where(goes_on, passes * (1.0 - tl.abs(found)), passes)
        if OBJECTS:
            tl.store(past_before + own, tl.where(goes_on, past, 0.0))
            past = tl.where(goes_on, past * tl.load(past_objects + own), past)
        goes_on &= (found >= 0.0) & (passes > MIN_TRANSMITTANCE)
    tl.store(whole + at, 1.0 - passes, mask=inside)
    colors = inside[:, None] & (channel < CHANNELS - DEPTH)[None, :]
    tl.store(image + at[:, None] * (CHANNELS - DEPTH) + channel, total, mask=colors)
    if DEPTH:
        depth_sum = tl.sum(tl.where((channel == CHANNELS - 1)[None, :], total, 0.0), 1)
        tl.store(depth + at, depth_sum / tl.maximum(1.0 - passes, MIN_ALPHA), mask=inside)
    if OBJECTS:
        tl.store(objects_alpha + at, 1.0 - past, mask=inside)


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _composite_backward(
    values, alpha, past_objects, firsts, before, past_before, depth, whole, v_image, v_depth, v_whole, v_objects_alpha,
    v_values, v_alpha, v_past_objects, width, height, across, per_camera,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, OBJECTS: tl.constexpr,
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
    v_past = -tl.load(v_objects_alpha + at, mask=inside, other=0.0) if OBJECTS else 0.0
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
        if OBJECTS:
            tl.store(v_past_objects + own, v_past * tl.load(past_before + own))
            v_past = tl.where(reaches > 0.0, v_past * tl.load(past_objects + own), v_past)
