"""Errors of a rendered image by region on a GPU: what `drivesplat.evaluation.metrics` computes on a CPU."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.kernels.color_difference import C1, C2, window_taps


@torch.no_grad()
def gpu_error_sums(
    image: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    everything: Bool[np.ndarray, "h w"],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    device: torch.device,
) -> list[list[float]]:
    """The sums of the maps of `error_maps` over each of `masks`, added in double precision on `device`."""
    found = torch.from_numpy(image).to(device).double().clamp(0.0, 1.0)
    true = torch.from_numpy(truth).to(device).double()
    corrected = _color_corrected(found, true, torch.from_numpy(everything).to(device))
    errors = [(values - true).square().mean(dim=2) for values in (found, corrected)]
    maps = torch.stack([*errors, _ssim_map(found, true)], dim=-1).reshape(-1, len(errors) + 1)
    weights = torch.from_numpy(np.stack(masks)).to(device).flatten(1).double()
    return (weights @ maps).tolist()


def _color_corrected(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    rows = torch.cat([image, torch.ones_like(image[..., :1])], dim=2).flatten(0, 1)
    weighted = (rows * mask.flatten()[:, None]).mT
    normal, right = ((weighted @ values).cpu().numpy() for values in (rows, truth.flatten(0, 1)))
    affine = torch.from_numpy(np.linalg.lstsq(normal, right, rcond=None)[0]).to(image)
    return (image @ affine[:3] + affine[3]).clamp(0.0, 1.0)


def _ssim_map(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    x, y = (values.permute(2, 0, 1).float() - 0.5 for values in (image, truth))
    mean_x, mean_y, square_x, square_y, product = _windowed(torch.stack([x, y, x * x, y * y, x * y]))
    variances = square_x - mean_x * mean_x + square_y - mean_y * mean_y
    covariance = product - mean_x * mean_y
    mean_x, mean_y = mean_x + 0.5, mean_y + 0.5
    luminance = (2.0 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    return (luminance * (2.0 * covariance + C2) / (variances + C2)).mean(dim=0)


def _windowed(values: Float[Tensor, "k c h w"]) -> Float[Tensor, "k c h w"]:
    """Local means, reflected at the borders. Sums of shifted images: convolutions may round to TF32."""
    taps = window_taps().ravel().tolist()
    for dim in (2, 3):
        size, reach = values.shape[dim], len(taps) // 2
        reflected = torch.from_numpy(np.pad(np.arange(size), reach, mode="symmetric")).to(values.device)
        padded = values.index_select(dim, reflected)
        values = sum((tap * padded.narrow(dim, i, size) for i, tap in enumerate(taps)), torch.zeros_like(values))
    return values
