"""What compositing gives."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

MIN_ALPHA = 1e-10
"""Alpha by which a sum of depths is divided at least."""


class Composited(NamedTuple):
    """Images of values, premultiplied by alpha, and alpha. `objects_alpha` is that of some of the Gaussians alone, None
    where it was not computed beside the image. `depth` is the mean depth in metres, None where it is not wanted."""

    image: Float[Tensor, "c h w v"]
    alpha: Float[Tensor, "c h w 1"]
    objects_alpha: Float[Tensor, "c h w 1"] | None = None
    depth: Float[Tensor, "c h w 1"] | None = None


def with_depth_apart(image: Float[Tensor, "c h w v_more_1"], alpha: Float[Tensor, "c h w 1"]) -> Composited:
    """Of composited values of which the last is depth."""
    values, depth_sum = image.split([image.shape[-1] - 1, 1], dim=-1)  # slices would copy in their gradients
    return Composited(values, alpha, depth=depth_sum / alpha.clamp(min=MIN_ALPHA))
