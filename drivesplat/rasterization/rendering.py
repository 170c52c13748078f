"""The result of rasterization."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Rendering:
    """The images of c cameras.

    `image` is premultiplied by `alpha`: nothing is composited behind it. `depth` is the expected depth in metres along
    the camera axis, or None. `info` holds what gsplat's strategies read: `means2d`, `radii`, `depths`, `conics`,
    `opacities`, `width`, `height`, `n_cameras` and `gaussian_ids`.
    """

    image: Float[Tensor, "c h w channels"]
    alpha: Float[Tensor, "c h w 1"]
    depth: Float[Tensor, "c h w 1"] | None
    info: dict[str, Any]


def assembled(
    composited: Float[Tensor, "c h w channels"], alpha: Float[Tensor, "c h w 1"], with_depth: bool, **projected: Any
) -> Rendering:
    """A Rendering of composited values, whose last channel is depth times alpha where `with_depth`. `projected` are the
    Gaussians in the images: means2d, radii, depths, conics, opacities."""
    cameras, height, width = alpha.shape[:3]
    info = {**projected, "width": width, "height": height, "n_cameras": cameras, "gaussian_ids": None}
    if not with_depth:
        return Rendering(composited, alpha, None, info)
    return Rendering(composited[..., :-1], alpha, composited[..., -1:] / alpha.clamp(min=1e-10), info)
