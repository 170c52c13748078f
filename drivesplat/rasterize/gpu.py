"""gsplat behind the door."""

from typing import Any

from gsplat import rasterization
from torch import Tensor

from drivesplat.rasterize.rendering import Rendering, assembled


def rasterize_gsplat(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, sh_degree: int | None, antialiased: bool, absgrad: bool, with_depth: bool,
) -> Rendering:  # fmt: skip
    """See `drivesplat.rasterize.rasterize`. Needs a GPU."""
    if len(means) == 0:  # gsplat's kernels do not start on nothing
        shape = (len(viewmats), height, width)
        values = colors.shape[-1] + with_depth
        return assembled(means.new_zeros(*shape, values), means.new_zeros(*shape, 1), with_depth)
    image, alpha, info = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        sh_degree=sh_degree,
        packed=False,  # faster than packed at one image a step, and what gsplat's strategies read without a gather
        absgrad=absgrad,
        rasterize_mode="antialiased" if antialiased else "classic",
        render_mode="RGB+ED" if with_depth else "RGB",
    )  # fmt: skip
    strategy_info: dict[str, Any] = {**info, "gaussian_ids": None}
    if not with_depth:
        return Rendering(image, alpha, None, strategy_info)
    return Rendering(image[..., :-1], alpha, image[..., -1:], strategy_info)
