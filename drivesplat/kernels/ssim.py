"""The structural similarity of the training loss (Wang et al. 2004), as in 3DGS: an 11-tap Gaussian window with sigma
1.5, data range 1, zero-padded."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

TAPS = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def ssim(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """The mean similarity over pixels and channels. Gradients reach `image`, and on a GPU also `target`."""
    if image.device.type != "cpu":
        return ssim_in_torch(image, target)
    from drivesplat.kernels.numba.ssim import Similarity

    return Similarity.apply(image, target, window_taps(), C1, C2)


def ssim_in_torch(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """`ssim` by torch's convolutions, on any device: the reference for the compiled version."""
    offsets = torch.arange(TAPS, device=image.device, dtype=image.dtype) - TAPS // 2
    taps = torch.softmax(-(offsets**2) / (2 * SIGMA**2), dim=0)
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


def window_taps() -> np.ndarray:
    """The taps (11,) of the window along one axis; their sum is 1."""
    taps = np.exp(-((np.arange(TAPS) - TAPS // 2) ** 2) / (2 * SIGMA**2))
    return taps / taps.sum()
