"""The SSIM of the plain recipe's loss: the fused kernel of gsplat's example if it is installed, else torch."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

TAPS, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
FUSED = "fused_ssim"


@dataclass(frozen=True)
class Ssim:
    """A mean structural similarity of images (1, 3, h, w), and its name."""

    name: str
    of: Callable[[Tensor, Tensor], Tensor]


def chosen_ssim(device: torch.device) -> Ssim:
    """The example's choice for a device: the package `fused_ssim` on a GPU if it is installed."""
    if device.type == "cuda" and find_spec(FUSED) is not None:
        from fused_ssim import fused_ssim

        return Ssim(FUSED, lambda image, target: fused_ssim(image, target, padding="valid"))
    return Ssim("torch", torch_ssim)


def torch_ssim(image: Float[Tensor, "1 3 h w"], target: Float[Tensor, "1 3 h w"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) over all windows of 11 Gaussian taps that lie inside the image."""
    maps = torch.cat([image, target, image * image, target * target, image * target], dim=1)
    offsets = torch.arange(TAPS, device=image.device, dtype=image.dtype) - TAPS // 2
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    taps = (taps / taps.sum()).expand(maps.shape[1], 1, 1, TAPS)
    maps = F.conv2d(F.conv2d(maps, taps, groups=len(taps)), taps.transpose(2, 3), groups=len(taps))
    x, y, xx, yy, xy = maps.split(image.shape[1], dim=1)
    means, variances = x * x + y * y, (xx - x * x) + (yy - y * y)
    return ((2 * x * y + C1) * (2 * (xy - x * y) + C2) / ((means + C1) * (variances + C2))).mean()
