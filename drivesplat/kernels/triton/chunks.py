"""Tiles' lists of Gaussians cut into chunks, and what chunks show put together again.

A block of the rasterizer goes through the list of a tile, one Gaussian after the other. On a drive what lies far ahead
is in a few tiles: their lists are tens of times as long as others', and all wait for them. Chunks are rasterized side
by side, each an image of a tile's size, and composited front to back.
"""

from collections.abc import Callable
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.triton.tiles import TILE, Lists, Projected

LENGTH = 512
"""Most Gaussians of a chunk."""
MOST_VALUES = 8
"""Of a Gaussian: every entry of a list has its own copy of them."""
BLOCK = 4096
"""Tiles that are counted at a time."""

Rasterizer = Callable[..., tuple[Tensor, Tensor]]


def composited(
    gaussians: Projected, lists: Lists, width: int, height: int, rasterizer: Rasterizer
) -> tuple[Float[Tensor, "c h w v"], Float[Tensor, "c h w 1"]]:
    """What gsplat's `rasterize_to_pixels` makes of the same, values and alpha; `rasterizer` is that, for chunks.

    Within rounding: a pixel ends where a chunk lets less than 1e-4 of the light through, which further ones may add to.
    """
    *apart, starts, there, firsts = _Cut.apply(*gaussians, lists)
    edge = TILE.value
    each = torch.arange(len(lists.ids), dtype=torch.int32, device=lists.ids.device)
    values, alpha = rasterizer(*apart, edge, edge, edge, starts, each, masks=there, packed=True)
    return _PutTogether.apply(values, alpha, firsts, lists.tiles, width, height)


class _Cut(torch.autograd.Function):
    """Gaussians tile by tile, in coordinates of their tile, with where chunks start (m, 1, 1), which of them there are
    (m, 1, 1), and which is every tile's first."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, conics: Tensor, values: Tensor, opacities: Tensor, lists: Lists
    ) -> tuple[Tensor, ...]:
        given = [tensor.contiguous() for tensor in (means, conics, values, opacities)]
        room, (cameras, down, across) = len(lists.ids), lists.tiles
        tiles = cameras * down * across
        chunks = tiles + room // LENGTH + 1  # every chunk is followed by another, which is where it ends
        starts, firsts = lists.ids.new_empty(chunks, 1, 1), lists.ids.new_empty(tiles + 1)
        there = torch.empty(chunks, 1, 1, dtype=torch.bool, device=means.device)
        apart = [means.new_empty(room, width) for width in (2, 3, values.shape[-1])] + [means.new_empty(room)]
        _count_chunks[(1,)](lists.offsets, firsts, tiles, LENGTH, BLOCK)
        _take_apart[(chunks,)](
            *given, *lists[:3], firsts, *apart, starts, there,
            tiles, down * across, across, tiles.bit_length(), values.shape[-1], LENGTH,
        )  # fmt: skip
        ctx.save_for_backward(*lists[:3], firsts, starts)
        ctx.shapes = [tensor.shape for tensor in given]
        ctx.mark_non_differentiable(starts, there, firsts)
        return *apart, starts, there, firsts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulls: Tensor) -> tuple[Tensor | None, ...]:
        ids, order, offsets, firsts, starts = ctx.saved_tensors
        apart = [tensor.contiguous() for tensor in pulls[:4]]
        summed = [tensor.new_zeros(shape) for tensor, shape in zip(apart, ctx.shapes, strict=True)]
        tiles = len(offsets) - 1
        _add_up[(len(starts),)](*apart, ids, order, offsets, firsts, starts, *summed, tiles, ctx.shapes[2][-1], LENGTH)
        return *summed, None


class _PutTogether(torch.autograd.Function):
    """Images (c, h, w, v) and their alpha (c, h, w, 1) of what chunks show."""

    @staticmethod
    def forward(
        ctx: Any, values: Tensor, alpha: Tensor, firsts: Tensor, tiles: tuple[int, int, int], width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        cameras, down, across = tiles
        values, alpha, channels = values.contiguous(), alpha.contiguous(), values.shape[-1]
        before = torch.empty_like(alpha)
        image = values.new_empty(cameras, height, width, channels)
        whole = values.new_empty(cameras, height, width, 1)
        ctx.sizes = (width, height, across, down * across, channels, triton.next_power_of_2(channels))
        _composite[(cameras * down * across,)](values, alpha, firsts, before, image, whole, *ctx.sizes)
        ctx.save_for_backward(values, alpha, firsts, before)
        return image, whole

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_whole: Tensor) -> tuple[Tensor | None, ...]:
        values, alpha, firsts, before = ctx.saved_tensors
        v_values, v_alpha = torch.empty_like(values), torch.empty_like(alpha)
        _pull_apart[(len(firsts) - 1,)](
            values, alpha, firsts, before, v_image.contiguous(), v_whole.contiguous(), v_values, v_alpha, *ctx.sizes
        )
        return v_values, v_alpha, None, None, None, None


@triton.jit(do_not_specialize=["tiles"])
@no_type_check
def _count_chunks(offsets, firsts, tiles, LENGTH: tl.constexpr, BLOCK: tl.constexpr):
    """The first chunk of every tile, and behind them how many chunks there are."""
    found = 0
    for begin in range(0, tiles, BLOCK):
        tile = begin + tl.arange(0, BLOCK)
        inside = tile < tiles
        entries = tl.load(offsets + tile + 1, mask=inside, other=0) - tl.load(offsets + tile, mask=inside, other=0)
        chunks = (entries + LENGTH - 1) // LENGTH
        tl.store(firsts + tile, found + tl.cumsum(chunks, 0) - chunks, mask=inside)
        found += tl.sum(chunks)
    tl.store(firsts + tiles, found)


@triton.jit(do_not_specialize=["tiles", "per_camera", "across", "steps"])
@no_type_check
def _take_apart(
    means, conics, values, opacities, ids, order, offsets, firsts, means_apart, conics_apart, values_apart,
    opacities_apart, starts, there, tiles, per_camera, across, steps, CHANNELS: tl.constexpr, LENGTH: tl.constexpr,
):  # fmt: skip
    """The Gaussians of a chunk; a chunk that there is not starts where all end."""
    chunk = tl.program_id(0)
    is_one = chunk < tl.load(firsts + tiles)
    low, high = 0, tiles
    for _ in range(steps):  # the last tile whose first chunk is not behind this one
        middle = (low + high) // 2
        behind = tl.load(firsts + middle) <= chunk
        low, high = tl.where(behind, middle, low), tl.where(behind, high, middle)
    start = tl.load(offsets + low) + (chunk - tl.load(firsts + low)) * LENGTH
    start = tl.where(is_one, start, tl.load(offsets + tiles))
    tl.store(starts + chunk, start)
    tl.store(there + chunk, is_one)
    place = start.to(tl.int64) + tl.arange(0, LENGTH)
    inside = is_one & (place < tl.load(offsets + low + 1))
    i = tl.load(ids + tl.load(order + place, mask=inside, other=0), mask=inside, other=0).to(tl.int64)
    left, top = (low % per_camera) % across * TILE, (low % per_camera) // across * TILE
    tl.store(means_apart + 2 * place, tl.load(means + 2 * i, mask=inside, other=0.0) - left, mask=inside)
    tl.store(means_apart + 2 * place + 1, tl.load(means + 2 * i + 1, mask=inside, other=0.0) - top, mask=inside)
    for k in tl.static_range(3):
        tl.store(conics_apart + 3 * place + k, tl.load(conics + 3 * i + k, mask=inside, other=0.0), mask=inside)
    for k in tl.static_range(CHANNELS):
        value = tl.load(values + CHANNELS * i + k, mask=inside, other=0.0)
        tl.store(values_apart + CHANNELS * place + k, value, mask=inside)
    tl.store(opacities_apart + place, tl.load(opacities + i, mask=inside, other=0.0), mask=inside)


@triton.jit
@no_type_check
def _add(total, value, inside):
    """Adds what is not 0."""
    tl.atomic_add(total, value, mask=inside & (value != 0.0), sem="relaxed")


@triton.jit(do_not_specialize=["tiles"])
@no_type_check
def _add_up(
    v_means_apart, v_conics_apart, v_values_apart, v_opacities_apart, ids, order, offsets, firsts, starts, v_means,
    v_conics, v_values, v_opacities, tiles, CHANNELS: tl.constexpr, LENGTH: tl.constexpr,
):  # fmt: skip
    """The gradients of a chunk's Gaussians, added to those of all."""
    chunk = tl.program_id(0)
    is_one = chunk < tl.load(firsts + tiles)
    place = tl.load(starts + chunk).to(tl.int64) + tl.arange(0, LENGTH)
    inside = is_one & (place < tl.load(starts + chunk + 1, mask=is_one, other=0))
    i = tl.load(ids + tl.load(order + place, mask=inside, other=0), mask=inside, other=0).to(tl.int64)
    for k in tl.static_range(2):
        _add(v_means + 2 * i + k, tl.load(v_means_apart + 2 * place + k, mask=inside, other=0.0), inside)
    for k in tl.static_range(3):
        _add(v_conics + 3 * i + k, tl.load(v_conics_apart + 3 * place + k, mask=inside, other=0.0), inside)
    for k in tl.static_range(CHANNELS):
        value = tl.load(v_values_apart + CHANNELS * place + k, mask=inside, other=0.0)
        _add(v_values + CHANNELS * i + k, value, inside)
    _add(v_opacities + i, tl.load(v_opacities_apart + place, mask=inside, other=0.0), inside)


@triton.jit
@no_type_check
def _pixels(tile, width, height, across, per_camera):
    """The places of a tile's pixels among all cameras', and which of them are in the image."""
    pixel = tl.arange(0, TILE * TILE)
    camera, within = tile // per_camera, tile % per_camera
    x, y = within % across * TILE + pixel % TILE, within // across * TILE + pixel // TILE
    return (camera * height + y) * width + x, (x < width) & (y < height)


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _composite(
    values, alpha, firsts, before, image, whole, width, height, across, per_camera,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """A tile of the image, and how much light comes through to each of its chunks."""
    tile = tl.program_id(0)
    at, inside = _pixels(tile, width, height, across, per_camera)
    pixel, channel = tl.arange(0, TILE * TILE).to(tl.int64), tl.arange(0, WIDTH)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    total = tl.zeros((TILE * TILE, WIDTH), tl.float32)
    for chunk in range(tl.load(firsts + tile), tl.load(firsts + tile + 1)):
        own = chunk * TILE * TILE + pixel
        tl.store(before + own, passes)
        shown = tl.load(values + own[:, None] * CHANNELS + channel, mask=(channel < CHANNELS)[None, :], other=0.0)
        total += passes[:, None] * shown
        passes *= 1.0 - tl.load(alpha + own)
    tl.store(whole + at, 1.0 - passes, mask=inside)
    tl.store(image + at[:, None] * CHANNELS + channel, total, mask=inside[:, None] & (channel < CHANNELS)[None, :])


@triton.jit(do_not_specialize=["width", "height", "across", "per_camera"])
@no_type_check
def _pull_apart(
    values, alpha, firsts, before, v_image, v_whole, v_values, v_alpha, width, height, across, per_camera,
    CHANNELS: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """The gradients of a tile's chunks, from the last to the first."""
    tile = tl.program_id(0)
    at, inside = _pixels(tile, width, height, across, per_camera)
    pixel, channel = tl.arange(0, TILE * TILE).to(tl.int64), tl.arange(0, WIDTH)
    there = (channel < CHANNELS)[None, :]
    pull = tl.load(v_image + at[:, None] * CHANNELS + channel, mask=inside[:, None] & there, other=0.0)
    pull_alpha = tl.load(v_whole + at, mask=inside, other=0.0)
    passes = tl.full((TILE * TILE,), 1.0, tl.float32)
    behind = tl.zeros((TILE * TILE, WIDTH), tl.float32)
    first, last = tl.load(firsts + tile), tl.load(firsts + tile + 1)
    for step in range(last - first):
        own = (last - 1 - step) * TILE * TILE + pixel
        reaches, left = tl.load(before + own), 1.0 - tl.load(alpha + own)
        tl.store(v_values + own[:, None] * CHANNELS + channel, reaches[:, None] * pull, mask=there)
        tl.store(v_alpha + own, reaches * (pull_alpha * passes - tl.sum(pull * behind, 1)))
        shown = tl.load(values + own[:, None] * CHANNELS + channel, mask=there, other=0.0)
        behind = shown + left[:, None] * behind
        passes *= left
