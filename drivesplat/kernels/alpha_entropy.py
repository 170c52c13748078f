"""Means over the pixels of an alpha image that loss terms penalise: its entropy, and its cross entropy with a mask."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.kernels import triton_support

CERTAIN = 1e-4
"""Alpha is limited to [CERTAIN, 1 - CERTAIN], for finite logarithms; beyond there is no gradient."""


def mean_entropy(alpha: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean of -o ln o - (1 - o) ln (1 - o) over an image of alpha o: smallest where alpha is 0 or 1."""
    if _fused(alpha):
        return _triton(alpha, None)
    o = alpha.clamp(CERTAIN, 1.0 - CERTAIN)
    return -(o * torch.log(o) + (1.0 - o) * torch.log1p(-o)).mean()


def mean_cross_entropy(alpha: Float[Tensor, "h w"], empty: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean of -ln (1 - o) over `empty` pixels, and of -ln o over the others, of an image of alpha o."""
    if _fused(alpha):
        return _triton(alpha, empty)
    o = alpha.clamp(CERTAIN, 1.0 - CERTAIN)
    return -torch.where(empty, 1.0 - o, o).log().mean()


def _fused(alpha: Float[Tensor, "h w"]) -> bool:
    return alpha.numel() > 0 and triton_support.usable_for(alpha)


def _triton(alpha: Float[Tensor, "h w"], empty: Bool[Tensor, "h w"] | None) -> Float[Tensor, ""]:
    from drivesplat.kernels.triton.alpha_entropy import MeanEntropy

    return MeanEntropy.apply(alpha, empty, CERTAIN)
