"""How far a depth image is off what LiDAR measured at some of its pixels."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import triton_support

KEPT_PERCENT = 95
"""Per cent of the measured pixels that count: those with the smallest errors."""


def mean_depth_error(
    depth: Float[Tensor, "h w"],
    pixels: Int[Tensor, " m"],
    measured: Float[Tensor, " m"],
    count: Int[Tensor, ""] | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute difference (metres) between `depth` at row-major `pixels` and what was `measured` there, without
    the largest 5 %, of the first `count` of these (None: all). 0 if there are none.

    A `count` on a GPU is not waited for. There, errors beside the last one that counts share its weight with it where
    they agree with it in the first 14 bits of their mantissa.
    """
    if len(pixels) and triton_support.usable_for(depth):
        from drivesplat.kernels.triton.depth_error import MeanDepthError

        all_of_them = torch.full((), len(pixels), device=depth.device) if count is None else count
        return MeanDepthError.apply(depth, pixels, measured, all_of_them, KEPT_PERCENT)
    errors = (depth.reshape(-1).index_select(0, pixels) - measured).abs()
    if count is not None:
        return _mean_of_smallest(errors, count)
    kept = max(1, len(errors) * KEPT_PERCENT // 100)
    return torch.topk(errors, min(kept, len(errors)), largest=False, sorted=False).values.sum() / kept


def _mean_of_smallest(errors: Float[Tensor, " m"], count: Int[Tensor, ""]) -> Float[Tensor, ""]:
    """The mean of the first `count` errors without the largest 5 %. Does not synchronise with the device."""
    places = torch.arange(len(errors), device=errors.device)
    ordered = torch.where(places < count, errors, torch.inf).sort().values
    kept = (count * KEPT_PERCENT // 100).clamp(min=1)
    return torch.where(places < torch.minimum(kept, count), ordered, 0.0).sum() / kept
