"""Colours of the sky's cube map where no training image sees through the scene.

The only gradient of such texels comes from the little light that opaque surfaces let through; Adam amplifies it to
noise. They show wherever Gaussians leave a hole: behind a removed vehicle, and from beside the path. After the training
they get the mean colour that static pixels of training images have in their direction, so that a hole looks like what
surrounds it.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from drivesplat.model.sky import CubemapSky, logit_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.training.views import TrainingView

SEEN = 0.25
"""Texel areas seen through the scene, summed over images, at which a texel keeps half of what it has learned."""
MIN_PIXELS = 0.01
"""Pixels that a texel needs for a mean colour. Interpolation at the edges of faces leaks a millionth of a pixel."""
NEIGHBOURS = 16
"""Texels with a mean colour that those without one average."""


@torch.no_grad()
def fill_unseen_sky(model: SplatModel, views: list[TrainingView]) -> None:
    """Replaces the colours of unseen texels of a cube map, in place; without one, or without views, does nothing.

    A texel keeps its logits with the weight w² / (w² + SEEN²). w is the sum of squared transmittance over the pixels
    that interpolate it, in all views, divided by the number of pixels that a texel has in an image. Pixels of the ego
    vehicle and of moving objects, where views have masks of them, have no effect. Objects of the model give no colour.
    """
    sky = model.sky
    if not isinstance(sky, CubemapSky) or not views:
        return
    texels = sky.params["texels"]
    through, sums = torch.zeros_like(texels[:, :1]), torch.zeros(len(texels), 4).to(texels)
    for view in views:
        picture, seen_from = model.render(view.view, with_objects=True), model.seen_from(view.view)
        alpha, objects = picture.alpha[..., None], model.objects_alpha(picture, view.view)
        static = torch.ones_like(alpha)
        for mask in (view.ego_mask, view.moving):
            static = static if mask is None else static * ~mask[..., None]
        background = static if objects is None else static * (1.0 - objects[..., None])
        colors = sky.behind(picture.splats, alpha, seen_from)
        values = torch.cat([static * (1.0 - alpha).square(), background * colors, background], dim=-1)
        found = sky.sums(seen_from.rays(), values)
        through += found[:, :1] / _texel_area(sky, view)
        sums += found[:, 1:]
    known = sums[:, 3] > MIN_PIXELS
    if known.any():
        means = _completed(sky.directions(), sums[:, :3] / sums[:, 3:].clamp(min=1e-12), known)
        kept = through.square() / (through.square() + SEEN**2)
        texels.copy_(torch.lerp(logit_of(means), texels, kept))


def _texel_area(sky: CubemapSky, view: TrainingView) -> float:
    """The pixels of an image that a texel in the middle of a face covers."""
    width = 2.0 / (sky.index.shape[-1] - 1)
    return float(view.view.K[0, 0] * view.view.K[1, 1]) * width**2


def _completed(directions: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], known: Tensor) -> Float[Tensor, "n 3"]:
    """Colours of all directions: those `known` (n,) bool, and elsewhere means of the nearest, by inverse square
    distance."""
    at, mask = torch.nn.functional.normalize(directions, dim=1).cpu().numpy(), known.cpu().numpy()
    given = colors[known].cpu().numpy()
    distances, nearest = cKDTree(at[mask]).query(at[~mask], k=np.arange(1, min(NEIGHBOURS, len(given)) + 1))
    weights = 1.0 / (distances**2 + 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    completed = colors.clone()
    completed[~known] = torch.from_numpy((weights[..., None] * given[nearest]).sum(axis=1)).to(colors)
    return completed
