"""The structural similarity that trainings are held to (Wang et al. 2004), as 3DGS trains with: 11 Gaussian taps, sigma
1.5, data range 1, zero-padded."""

from typing import Any, no_type_check

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from drivesplat.kernels import kernel
from drivesplat.rasterize.cpu.threads import parallel_for

TAPS = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
ROWS = 16
"""Rows of an image a piece."""


def ssim(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """The mean of the similarity over pixels and channels, with gradients for `image`; for `target` on a GPU alone."""
    return _OnCpu.apply(image, target) if image.device.type == "cpu" else ssim_in_torch(image, target)


def ssim_in_torch(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """The same by torch's convolutions, on any device: what the other is held to."""
    taps = torch.from_numpy(weights()).to(image)
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    maps = torch.cat([x, y, x * x, y * y, x * y])[None]
    channels = maps.shape[1]
    for size, padding in (((TAPS, 1), (TAPS // 2, 0)), ((1, TAPS), (0, TAPS // 2))):
        maps = F.conv2d(maps, taps.view(1, 1, *size).expand(channels, 1, *size), padding=padding, groups=channels)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = maps[0].split(3)
    var_x, var_y, covariance = mean_xx - mean_x**2, mean_yy - mean_y**2, mean_xy - mean_x * mean_y
    return (
        (2 * mean_x * mean_y + C1) * (2 * covariance + C2) / ((mean_x**2 + mean_y**2 + C1) * (var_x + var_y + C2))
    ).mean()


def weights() -> np.ndarray:
    """The taps (11,), which sum to 1."""
    taps = np.exp(-((np.arange(TAPS) - TAPS // 2) ** 2) / (2 * SIGMA**2))
    return taps / taps.sum()


class _OnCpu(torch.autograd.Function):
    """OpenCV's separable filter for the windows, and a compiled kernel for what is done pixel by pixel.

    The window is symmetric and zero-padded, so that it is its own adjoint: the gradient is the sum of three filtered
    maps, of what the similarity changes by with the local means of x, x² and xy.
    """

    @staticmethod
    def forward(ctx: Any, image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
        x, y = (values.detach().contiguous().numpy() for values in (image, target))
        means = [_windowed(values) for values in (x, y, x * x, y * y, x * y)]
        slopes = [np.empty_like(x) for _ in range(3)]
        sums = np.zeros(-(-len(x) // ROWS))
        parallel_for(_similarity, len(x), ROWS, *means, *slopes, sums)
        ctx.of_image = (x, y, *slopes)
        return image.new_tensor(sums.sum() / x.size)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Float[Tensor, ""]) -> tuple[Float[Tensor, "h w 3"], None]:
        x, y, *slopes = ctx.of_image
        by_x, by_xx, by_xy = (_windowed(slope) for slope in slopes)
        gradient = torch.from_numpy(by_x + 2.0 * x * by_xx + y * by_xy)
        return gradient.mul_(v_mean / x.size), None


def _windowed(values: np.ndarray) -> np.ndarray:
    """Local means (h, w, 3), beyond whose border there is nothing."""
    return cv2.sepFilter2D(values, -1, weights(), weights(), borderType=cv2.BORDER_CONSTANT)


@kernel
@no_type_check
def _similarity(start, stop, mean_x, mean_y, mean_xx, mean_yy, mean_xy, by_x, by_xx, by_xy, sums):
    """Rows `start` to `stop` of the similarity, summed, and what it changes by with three of the local means."""
    total = 0.0
    for row in range(start, stop):
        for column in range(mean_x.shape[1]):
            for channel in range(3):
                at = (row, column, channel)
                x, y = mean_x[at], mean_y[at]
                numerator_1, numerator_2 = 2 * x * y + C1, 2 * (mean_xy[at] - x * y) + C2
                denominator_1 = x * x + y * y + C1
                denominator_2 = mean_xx[at] - x * x + mean_yy[at] - y * y + C2
                scale = 1 / (denominator_1 * denominator_2)
                value = numerator_1 * numerator_2 * scale
                total += value
                by_xy[at] = 2 * numerator_1 * scale
                by_xx[at] = -value / denominator_2
                by_x[at] = 2 * y * (numerator_2 - numerator_1) * scale + 2 * x * value * (
                    1 / denominator_2 - 1 / denominator_1
                )
    sums[start // ROWS] = total
