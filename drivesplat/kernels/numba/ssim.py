"""Structural similarity and its gradient: OpenCV computes local means, a compiled kernel the rest."""

from typing import Any, no_type_check

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels.cache import kernel
from drivesplat.kernels.numba.threads import parallel_for

ROWS = 16
"""Rows of an image per chunk."""


class Similarity(torch.autograd.Function):
    """The mean similarity of an image to a target, both (h, w, 3), with gradients for `image` only; `taps` of the
    window along each axis, and the two constants that keep it finite.

    The window is symmetric and zero-padded, hence its own adjoint: the gradient is the sum of three filtered maps, the
    derivatives of the similarity by the local means of x, x² and xy.
    """

    @staticmethod
    def forward(
        ctx: Any, image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], taps: np.ndarray, c1: float, c2: float
    ) -> Float[Tensor, ""]:
        x, y = (values.detach().contiguous().numpy() for values in (image, target))
        means = [_windowed(values, taps) for values in (x, y, x * x, y * y, x * y)]
        slopes = [np.empty_like(x) for _ in range(3)]
        sums = np.zeros(-(-len(x) // ROWS))
        parallel_for(_similarity, len(x), ROWS, *means, *slopes, sums, c1, c2)
        ctx.of_image = (x, y, taps, *slopes)
        return image.new_tensor(sums.sum() / x.size)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Float[Tensor, ""]) -> tuple[Tensor | None, ...]:
        x, y, taps, *slopes = ctx.of_image
        by_x, by_xx, by_xy = (_windowed(slope, taps) for slope in slopes)
        gradient = torch.from_numpy(by_x + 2.0 * x * by_xx + y * by_xy)
        return gradient.mul_(v_mean / x.size), None, None, None, None


def _windowed(values: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Local means (h, w, 3), zero-padded."""
    return cv2.sepFilter2D(values, -1, taps, taps, borderType=cv2.BORDER_CONSTANT)


@kernel
@no_type_check
def _similarity(start, stop, mean_x, mean_y, mean_xx, mean_yy, mean_xy, by_x, by_xx, by_xy, sums, c1, c2):
    """Sums the similarity over rows `start` to `stop`, and writes its derivatives by three of the local means."""
    total = 0.0
    for row in range(start, stop):
        for column in range(mean_x.shape[1]):
            for channel in range(3):
                at = (row, column, channel)
                x, y = mean_x[at], mean_y[at]
                numerator_1, numerator_2 = 2 * x * y + c1, 2 * (mean_xy[at] - x * y) + c2
                denominator_1 = x * x + y * y + c1
                denominator_2 = mean_xx[at] - x * x + mean_yy[at] - y * y + c2
                scale = 1 / (denominator_1 * denominator_2)
                value = numerator_1 * numerator_2 * scale
                total += value
                by_xy[at] = 2 * numerator_1 * scale
                by_xx[at] = -value / denominator_2
                by_x[at] = 2 * y * (numerator_2 - numerator_1) * scale + 2 * x * value * (
                    1 / denominator_2 - 1 / denominator_1
                )
    sums[start // ROWS] = total
