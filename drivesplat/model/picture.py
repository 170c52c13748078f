"""A rendering of a model in a view."""

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from drivesplat.model.gaussians import Gaussians, GaussianSets


@dataclass(frozen=True)
class Picture:
    """A rendering of `sets` of Gaussians: `image` with sky and the exposure of the view's camera; `splats` without sky
    in the model's own colours (premultiplied by their `alpha`), `depth` in metres or None; `objects_alpha`, the alpha
    of the parts with objects alone, None where it needs a second rendering. What is opaque may hide objects behind it
    in `objects_alpha`. `surface_depth`, in metres or None, is that of the surfaces shown, 0 where there are none; it
    has no gradient (`drivesplat.rasterization.rasterize`).
    """

    sets: GaussianSets
    image: Float[Tensor, "h w 3"]
    splats: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"] | None
    info: dict[str, Any]
    objects_alpha: Float[Tensor, "h w"] | None = None
    surface_depth: Float[Tensor, "h w"] | None = None

    @property
    def shapes(self) -> Gaussians:
        """The sets one after the other, without their colours."""
        return self.sets.shapes
