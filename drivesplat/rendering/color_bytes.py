"""Colours as 8-bit integers."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def to_uint8(colors: Float[Tensor, "*n 3"]) -> UInt8[Tensor, "*n 3"]:
    """Colours in [0, 1] rounded to the nearest uint8, on their device; values beyond [0, 1] are clipped."""
    return (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
