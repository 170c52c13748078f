"""L1 and structural similarity of an image to the recorded one, and their gradient, in four passes.

The window of the similarity is a product of taps along rows and along columns, so that every pass reads 11 values. It
is symmetric and zero-padded, hence its own adjoint: the gradient is the sum of three windowed maps, the derivatives of
the similarity by the local means of x, x² and xy.
"""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

BLOCK, ROWS, COLUMNS = 1024, 8, 128
"""Values per program: of a row, and rows by values in the passes along columns."""
SUMS = 4
"""Similarity, absolute difference, that of moving pixels, and the number of moving values."""


class ImageDifference(torch.autograd.Function):
    """The means l1, similarity and l1 of moving pixels (0 without any) of `drivesplat.kernels.color_difference`; `taps`
    (t,) of the window, an odd number, and the two constants of the similarity."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        pixels: Tensor,
        hidden: Tensor | None,
        moving: Tensor | None,
        taps: Tensor,
        c1: float,
        c2: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        image = image.contiguous()
        height, values = len(image), image[0].numel()
        means, slopes = image.new_empty(5, height, values), image.new_empty(3, height, values)
        count, masks = len(taps), (hidden is not None, moving is not None)
        blocks = (triton.cdiv(height, ROWS), triton.cdiv(values, COLUMNS))
        partial = image.new_empty(SUMS, blocks[0] * blocks[1])
        _means_along_rows[(height, triton.cdiv(values, BLOCK))](
            image, pixels, hidden, means, taps, height, values, masks[0], count, BLOCK
        )
        _similarity[blocks](
            image, pixels, hidden, moving, means, slopes, partial, taps, c1, c2,
            height, values, *masks, count, ROWS, COLUMNS,
        )  # fmt: skip
        sums = partial.sum(dim=1)
        moving_values = sums[3].clamp(min=1.0)
        ctx.save_for_backward(image, pixels, hidden, moving, slopes, moving_values, taps)
        return sums[1] / image.numel(), sums[0] / image.numel(), sums[2] / moving_values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_l1: Tensor, v_similarity: Tensor, v_moving: Tensor) -> tuple[Tensor | None, ...]:
        image, pixels, hidden, moving, slopes, moving_values, taps = ctx.saved_tensors
        height, values = len(image), image[0].numel()
        windowed, gradient = torch.empty_like(slopes), torch.empty_like(image)
        _window_along_rows[(3 * height, triton.cdiv(values, BLOCK))](slopes, windowed, taps, values, len(taps), BLOCK)
        _gradient[(triton.cdiv(height, ROWS), triton.cdiv(values, COLUMNS))](
            image, pixels, hidden, moving, windowed, gradient, taps, v_l1, v_similarity, v_moving, moving_values,
            height, values, hidden is not None, moving is not None, len(taps), ROWS, COLUMNS,
        )  # fmt: skip
        return gradient, None, None, None, None, None, None


@triton.jit
@no_type_check
def _visible(image, pixels, hidden, at, valid, HIDDEN: tl.constexpr):
    """Values of the image, replaced by the recorded ones where it is hidden, and the recorded values."""
    y = tl.load(pixels + at, mask=valid, other=0).to(tl.float32) / 255.0
    x = tl.load(image + at, mask=valid, other=0.0)
    if HIDDEN:
        x = tl.where(tl.load(hidden + at // 3, mask=valid, other=0) != 0, y, x)
    return x, y


@triton.jit
@no_type_check
def _block(height, values, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """A program's rows and columns, the indices of its values, and which of them are in the image."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    inside = (row < height)[:, None] & (column < values)[None, :]
    return row, column, row[:, None] * values + column[None, :], inside


@triton.jit(do_not_specialize=["height"])
@no_type_check
def _means_along_rows(
    image, pixels, hidden, means, taps, height, values, HIDDEN: tl.constexpr, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Writes x, y, x², y² and xy, windowed along rows, to the five maps in `means`."""
    row = tl.program_id(0)
    column = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    sum_x = tl.zeros((BLOCK,), tl.float32)
    sum_y, sum_xx, sum_yy, sum_xy = sum_x, sum_x, sum_x, sum_x
    for tap in tl.static_range(TAPS):
        at = column + 3 * (tap - TAPS // 2)
        valid = (at >= 0) & (at < values)
        weight = tl.load(taps + tap)
        x, y = _visible(image, pixels, hidden, row * values + at, valid, HIDDEN)
        sum_x += weight * x
        sum_y += weight * y
        sum_xx += weight * x * x
        sum_yy += weight * y * y
        sum_xy += weight * x * y
    at = row * values + column
    inside = column < values
    size = height * values
    tl.store(means + at, sum_x, mask=inside)
    tl.store(means + size + at, sum_y, mask=inside)
    tl.store(means + 2 * size + at, sum_xx, mask=inside)
    tl.store(means + 3 * size + at, sum_yy, mask=inside)
    tl.store(means + 4 * size + at, sum_xy, mask=inside)


@triton.jit
@no_type_check
def _window_along_rows(maps, windowed, taps, values, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Maps, one row after the other, windowed along rows."""
    row = tl.program_id(0)
    column = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    total = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(TAPS):
        at = column + 3 * (tap - TAPS // 2)
        total += tl.load(taps + tap) * tl.load(maps + row * values + at, mask=(at >= 0) & (at < values), other=0.0)
    tl.store(windowed + row * values + column, total, mask=column < values)


@triton.jit
@no_type_check
def _window_along_columns(
    map_, taps, row, column, height, values, TAPS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):
    """A block of a map windowed along columns."""
    total = tl.zeros((ROWS, COLUMNS), tl.float32)
    for tap in tl.static_range(TAPS):
        near = row + (tap - TAPS // 2)
        valid = ((near >= 0) & (near < height))[:, None] & (column < values)[None, :]
        at = near[:, None] * values + column[None, :]
        total += tl.load(taps + tap) * tl.load(map_ + at, mask=valid, other=0.0)
    return total


@triton.jit(do_not_specialize=["height"])
@no_type_check
def _similarity(
    image, pixels, hidden, moving, means, slopes, partial, taps, c1, c2, height, values,
    HIDDEN: tl.constexpr, MOVING: tl.constexpr, TAPS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Sums a block's similarity and absolute difference, and writes the similarity's derivatives to `slopes`."""
    row, column, at, inside = _block(height, values, ROWS, COLUMNS)
    size = height * values
    x = _window_along_columns(means, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    y = _window_along_columns(means + size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    xx = _window_along_columns(means + 2 * size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    yy = _window_along_columns(means + 3 * size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    xy = _window_along_columns(means + 4 * size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    numerator_1, numerator_2 = 2 * x * y + c1, 2 * (xy - x * y) + c2
    denominator_1, denominator_2 = x * x + y * y + c1, xx - x * x + yy - y * y + c2
    scale = 1.0 / (denominator_1 * denominator_2)
    value = numerator_1 * numerator_2 * scale
    by_x = 2 * y * (numerator_2 - numerator_1) * scale + 2 * x * value * (1.0 / denominator_2 - 1.0 / denominator_1)
    tl.store(slopes + at, by_x, mask=inside)
    tl.store(slopes + size + at, -value / denominator_2, mask=inside)
    tl.store(slopes + 2 * size + at, 2 * numerator_1 * scale, mask=inside)

    visible, recorded = _visible(image, pixels, hidden, at, inside, HIDDEN)
    error = tl.where(inside, tl.abs(visible - recorded), 0.0)
    programs = tl.num_programs(0) * tl.num_programs(1)
    place = partial + tl.program_id(0) * tl.num_programs(1) + tl.program_id(1)
    tl.store(place, tl.sum(tl.where(inside, value, 0.0)))
    tl.store(place + programs, tl.sum(error))
    if MOVING:
        moves = tl.load(moving + at // 3, mask=inside, other=0) != 0
        tl.store(place + 2 * programs, tl.sum(tl.where(moves, error, 0.0)))
        tl.store(place + 3 * programs, tl.sum(tl.where(moves, 1.0, 0.0)))
    else:
        tl.store(place + 2 * programs, 0.0)
        tl.store(place + 3 * programs, 0.0)


@triton.jit(do_not_specialize=["height"])
@no_type_check
def _gradient(
    image, pixels, hidden, moving, windowed, gradient, taps, v_l1, v_similarity, v_moving, moving_values,
    height, values, HIDDEN: tl.constexpr, MOVING: tl.constexpr, TAPS: tl.constexpr, ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):  # fmt: skip
    """The image's gradient in a block."""
    row, column, at, inside = _block(height, values, ROWS, COLUMNS)
    size = height * values
    by_x = _window_along_columns(windowed, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    by_xx = _window_along_columns(windowed + size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)
    by_xy = _window_along_columns(windowed + 2 * size, taps, row, column, height, values, TAPS, ROWS, COLUMNS)

    x, y = _visible(image, pixels, hidden, at, inside, False)
    share = tl.full((ROWS, COLUMNS), 1.0, tl.float32) * (tl.load(v_l1) / size)
    if MOVING:
        moves = tl.load(moving + at // 3, mask=inside, other=0) != 0
        share += tl.where(moves, tl.load(v_moving) / tl.load(moving_values), 0.0)
    error = x - y
    sign = tl.where(error > 0, 1.0, tl.where(error < 0, -1.0, 0.0))
    total = share * sign + tl.load(v_similarity) / size * (by_x + 2 * x * by_xx + y * by_xy)
    if HIDDEN:
        total = tl.where(tl.load(hidden + at // 3, mask=inside, other=0) != 0, 0.0, total)
    tl.store(gradient + at, total, mask=inside)
