"""The terms of the training loss, each named, so that each can be logged and blamed."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.settings.train import TrainSettings
from drivesplat.training.views import TrainingView

SSIM_TAPS = 11
SSIM_SIGMA = 1.5


def loss_terms(
    picture: Picture, view: TrainingView, model: SplatModel, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted terms whose sum is minimised."""
    target = view.target()
    terms = {
        "l1": (1.0 - settings.ssim_weight) * F.l1_loss(picture.image, target),
        "ssim": settings.ssim_weight * (1.0 - ssim(picture.image, target)),
    }
    if settings.opacity_reg:
        terms["opacity_reg"] = (
            settings.opacity_reg * torch.cat([torch.sigmoid(p.params["opacities"]) for p in model.parts]).mean()
        )
    if settings.scale_reg:
        terms["scale_reg"] = settings.scale_reg * torch.cat([torch.exp(p.params["scales"]) for p in model.parts]).mean()
    if view.sky is not None and model.sky is not None and model.sky.keeps_gaussians_out:
        terms["sky_alpha"] = settings.sky_alpha_weight * sky_alpha_loss(picture.alpha, view.sky)
    return terms


def sky_alpha_loss(alpha: Float[Tensor, "h w"], sky: Tensor) -> Float[Tensor, ""]:
    """Mean over the image of -log(1 - alpha) on sky pixels: the half of the cross entropy that empties the sky."""
    return (-torch.log((1.0 - alpha).clamp(min=1e-4)) * sky).mean()


def ssim(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al.

    2004) as 3DGS trains with: 11 Gaussian taps, sigma 1.5, data range 1, zero-padded.
    """
    taps = torch.arange(SSIM_TAPS, device=image.device, dtype=image.dtype) - SSIM_TAPS // 2
    kernel = torch.softmax(-(taps**2) / (2 * SSIM_SIGMA**2), dim=0)
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    maps = torch.cat([x, y, x * x, y * y, x * y])[None]
    channels = maps.shape[1]
    maps = F.conv2d(
        maps, kernel.view(1, 1, -1, 1).expand(channels, 1, -1, 1), padding=(SSIM_TAPS // 2, 0), groups=channels
    )
    maps = F.conv2d(
        maps, kernel.view(1, 1, 1, -1).expand(channels, 1, 1, -1), padding=(0, SSIM_TAPS // 2), groups=channels
    )
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = maps[0].split(3)
    var_x, var_y, covariance = mean_xx - mean_x**2, mean_yy - mean_y**2, mean_xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    return (
        (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    ).mean()
