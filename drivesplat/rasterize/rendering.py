"""What every rasterizer returns."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Rendering:
    """What C cameras see: `image` (C, h, w, channels), `alpha` (C, h, w, 1), `depth` (C, h, w, 1) in metres or None.

    `image` is premultiplied: nothing is composited behind it. `depth` is the expected depth along the camera axis.
    `info` holds what gsplat's densification strategies read (`means2d`, `radii`, `width`, `height`, `n_cameras`,
    `gaussian_ids`).
    """

    image: Float[Tensor, "c h w channels"]
    alpha: Float[Tensor, "c h w 1"]
    depth: Float[Tensor, "c h w 1"] | None
    info: dict[str, Any]
