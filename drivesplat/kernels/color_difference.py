"""The difference between an image and the recorded one: L1 and structural similarity."""

from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drivesplat.kernels import triton_support
from drivesplat.kernels.ssim import C1, C2, ssim, window_taps


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


@cache
def _taps(device: torch.device) -> Float[Tensor, " t"]:
    return torch.from_numpy(window_taps()).float().to(device)
