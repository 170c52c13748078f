"""The difference between an image and the recorded one: L1 and structural similarity (Wang et al. 2004), the latter as
in 3DGS: an 11-tap Gaussian window with sigma 1.5, data range 1, zero-padded."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drivesplat.kernels import triton_support

TAPS = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class ColorDifference:
    """Means over pixels and channels: the absolute difference `l1`, the structural similarity `ssim`, and the absolute
    difference over moving pixels (None without a mask of them)."""

    l1: Float[Tensor, ""]
    ssim: Float[Tensor, ""]
    moving_l1: Float[Tensor, ""] | None


def color_difference(
    image: Float[Tensor, "h w 3"],
    pixels: UInt8[Tensor, "h w 3"],
    hidden: Bool[Tensor, "h w"] | None,
    moving: Bool[Tensor, "h w"] | None,
) -> ColorDifference:
    """The difference between `image`, in [0, 1], and the recorded `pixels`; gradients reach `image`.

    Where the `hidden` mask is set (the ego vehicle's body), the image counts as recorded, and these pixels have no
    gradient. An SSIM window across the mask's edge compares the visible pixels only, and every other pixel keeps the
    weight that it has without a mask. Replacing the recorded pixels instead would leave a gradient behind the mask.
    """
    if triton_support.usable_for(image):
        from drivesplat.kernels.triton.color_difference import ImageDifference

        l1, similarity, moving_l1 = ImageDifference.apply(image, pixels, hidden, moving, _taps(image.device), C1, C2)
        return ColorDifference(l1, similarity, None if moving is None else moving_l1)
    target = pixels.float() / 255.0
    visible = image if hidden is None else torch.where(hidden[..., None], target, image)
    moving_l1 = None if moving is None else masked_l1(visible, target, moving)
    return ColorDifference(F.l1_loss(visible, target), ssim(visible, target), moving_l1)


def masked_l1(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference over a mask; 0 for an empty one."""
    difference = (image - target).abs().mean(dim=-1) * mask
    return difference.sum() / mask.sum().clamp(min=1)


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


@cache
def _taps(device: torch.device) -> Float[Tensor, " t"]:
    return torch.from_numpy(window_taps()).float().to(device)
