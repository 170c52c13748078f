"""Colours as bytes."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def nearest_bytes(colors: Float[Tensor, "*n 3"]) -> UInt8[Tensor, "*n 3"]:
    """Colours in [0, 1] to the nearest byte, on the device where they are; what is beyond, to the nearest there is."""
    return (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
