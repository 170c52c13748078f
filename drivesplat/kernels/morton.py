"""The Morton order of points: along a curve through space on which near points are mostly near each other."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

BITS = 21
"""Bits per axis, as many as 63 bits of a code hold."""
SPREADS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that move the bits of a number apart, so that two zeros follow each."""


@torch.no_grad()
def morton_order(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """The rows of `points` in Morton order: sorted by the interleaved bits of their coordinates, each in units of
    2**-BITS of the largest extent. Equal codes keep their order."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    lowest = points.amin(dim=0)
    extent = (points.amax(dim=0) - lowest).amax().clamp(min=1e-12).double()
    cells = ((points - lowest).double() / extent * (2**BITS - 1)).long()
    for shift, mask in SPREADS:
        cells = (cells | (cells << shift)) & mask
    codes = cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2)
    return torch.argsort(codes, stable=True)
