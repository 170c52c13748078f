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


def assembled(
    composited: Float[Tensor, "c h w channels"], alpha: Float[Tensor, "c h w 1"], with_depth: bool, **projected: Any
) -> Rendering:
    """What has been composited as a Rendering; `with_depth`: the last channel is the depth, weighted by alpha.

    `projected` are the Gaussians in the images, as strategies read them: means2d, radii, depths, conics, opacities.
    """
    cameras, height, width = alpha.shape[:3]
    info = {**projected, "width": width, "height": height, "n_cameras": cameras, "gaussian_ids": None}
    if not with_depth:
        return Rendering(composited, alpha, None, info)
    return Rendering(composited[..., :-1], alpha, composited[..., -1:] / alpha.clamp(min=1e-10), info)
