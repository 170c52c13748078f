"""Which group of Gaussians a pixel or a ray shows."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NOTHING = 1e-6
"""Share of a group below which it is not met."""
CHANNELS = 4
"""Groups composited at once. A fixed number, since kernels are compiled for each."""


def strongest_group(
    groups: Int[Tensor, " n"],
    composite: Callable[[Bool[Tensor, "n c"]], Float[Tensor, "a b c"]],
    behind: Float[Tensor, "a b"] | None = None,
) -> Int[Tensor, "a b"]:
    """The one of `groups`, numbers from -1 of n Gaussians, that contributes most; -1 where nothing is met, or where
    what is `behind` all of them, such as the sky, contributes more. `composite` renders values of Gaussians."""
    numbers, own = groups.unique(return_inverse=True)
    most = found = None
    for first in range(0, max(1, len(numbers)), CHANNELS):
        weight, number = composite(own[:, None] == torch.arange(first, first + CHANNELS, device=own.device)).max(dim=-1)
        if most is None or found is None:
            most, found = torch.full_like(weight, NOTHING), torch.full_like(number, -1, dtype=groups.dtype)
        if len(numbers):
            better = weight > most
            found = torch.where(better, numbers[(first + number).clamp(max=len(numbers) - 1)], found)
            most = torch.where(better, weight, most)
    assert most is not None and found is not None
    return found if behind is None else torch.where(most > behind, found, -1)
