"""What no training image shows: gaps of the road, and colours of the sky's cube map and of Gaussians behind objects.

The only gradient of these comes from the little light that opaque surfaces let through, and Adam amplifies it: texels
learn noise, and Gaussians behind a vehicle that was followed learn the colour of the vehicle. They show where Gaussians
leave a hole, where an object is removed, and from beside the path. After the training they get colours of their
surroundings.
"""

import logging
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from drivesplat.kernels.morton import morton_order
from drivesplat.model.part import Part
from drivesplat.model.road import RoadPart
from drivesplat.model.sky import CubemapSky, logit_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view_colors import all_view_colors
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

COVERED = 0.2
"""Share of a pixel that objects need for the pixel to show them rather than the static scene."""
MIN_WEIGHT = 0.02
"""Sum of the weights in pixels, over all images, that a Gaussian needs to keep the colour that it has learned."""
SEEN = 0.25
"""Texel areas seen through the scene, summed over images, at which a texel keeps half of what it has learned."""
MIN_PIXELS = 0.01
"""Pixels that a texel needs for a mean colour. Interpolation at the edges of faces leaks a millionth of a pixel."""
NEIGHBOURS = {"texel": 16, "gaussian": 8}
"""The nearest ones with a colour that those without one average."""


@torch.no_grad()
def fill_unseen(model: SplatModel, views: list[TrainingView]) -> None:
    """Fills gaps of the road, and replaces colours that no training image shows, in place; without views does nothing.

    In a model with objects, `fill_road` closes gaps, and static Gaussians whose weights in pixels of the static scene
    sum to less than `MIN_WEIGHT` get the mean colour of the nearest other ones, the same from all sides. Most of them
    are behind objects in all images; others are outside all images, or almost transparent.

    A texel of a cube map keeps its logits with the weight w² / (w² + SEEN²). w is the sum of squared transmittance over
    the pixels that interpolate it, in all views, divided by the number of pixels that a texel has in an image. The rest
    is the mean colour of the pixels of the static scene in its direction, or that of the nearest texels with such
    pixels. Pixels of moving objects, where views have masks of them, count neither in w nor in means.

    Objects of the model cover less than `COVERED` of a pixel of the static scene. Pixels of the ego vehicle have no
    effect.
    """
    has_objects = any(part.has_objects for part in model.parts)
    texels = _TexelColors(model.sky) if isinstance(model.sky, CubemapSky) else None
    if not views or not (has_objects or texels):
        return
    if has_objects:
        fill_road(model, views)
    weights = _no_weights(model)
    for view in views:
        shown = _shown(model, view, has_objects)
        weights += shown.weights
        if texels is not None:
            texels.add(model, view, shown)
    if has_objects:
        for part, rows in zip(model.parts, model.rows, strict=True):
            if not part.moves:
                _recolour(part, weights[rows] < MIN_WEIGHT)
    if texels is not None:
        texels.fill()


@torch.no_grad()
def fill_road(model: SplatModel, views: list[TrainingView]) -> None:
    """Adds Gaussians to gaps of the road, in place, but for those that an image would show: their weights in pixels of
    the static scene sum to `MIN_WEIGHT` or more."""
    for number, part in enumerate(model.parts):
        if isinstance(part, RoadPart):
            count, fillers = len(part), part.gap_fillers()
            part.extend(fillers, count)
            weights = _no_weights(model)
            for view in views if len(part) > count else ():
                weights += _shown(model, view, has_objects=True).weights
            unseen = weights[model.rows[number]][count:] < MIN_WEIGHT
            part.extend({name: values[unseen] for name, values in fillers.items()}, count)
            log.info("%d Gaussians fill gaps of the road that no image shows", int(unseen.sum()))


def _no_weights(model: SplatModel) -> Float[Tensor, " n"]:
    return torch.zeros(sum(part.row_count for part in model.parts), device=model.parts[0].params["means"].device)


@dataclass(frozen=True)
class _Shown:
    """What a model shows in a view: its colours premultiplied by alpha, alpha, the pixels that show the static scene,
    and the weight of each Gaussian, summed over these."""

    splats: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w 1"]
    static: Bool[Tensor, "h w"]
    weights: Float[Tensor, " n"]


def _shown(model: SplatModel, view: TrainingView, has_objects: bool) -> _Shown:
    """What a model shows in a view. Without objects there are no weights: they are 0.

    The share of a pixel that shows objects is the rendering of a value that is 1 for Gaussians of objects. It is linear
    in the values: its gradient for them are the weights.
    """
    gaussians = model.gaussians_in(view.view)
    colors = all_view_colors(gaussians, model.seen_from(view.view))
    if not has_objects:
        rendering = model.composited(gaussians, colors, view.view)
        splats, alpha = rendering.image.squeeze(0), rendering.alpha.squeeze(0)
        return _Shown(splats, alpha, torch.ones_like(alpha[..., 0], dtype=torch.bool), colors.new_zeros(len(colors)))
    of_parts = [torch.full((part.row_count, 1), float(part.has_objects)) for part in model.parts]
    objects = torch.cat(of_parts).to(colors).requires_grad_()
    with torch.enable_grad():
        rendering = model.composited(gaussians, torch.cat([colors, objects], dim=1), view.view)
        splats, share = rendering.image.squeeze(0).split([3, 1], dim=2)
        static = share.detach().squeeze(2) < COVERED
        static = static if view.ego_mask is None else static & ~view.ego_mask
        shown = (share.squeeze(2) * static).sum()  # with a gradient for `share` itself, torch would import sympy
        (weights,) = torch.autograd.grad(shown, objects)
    return _Shown(splats.detach(), rendering.alpha.detach().squeeze(0), static, weights[:, 0])


def _recolour(part: Part, hidden: Bool[Tensor, " n"]) -> None:
    """Gives `hidden` Gaussians of a part the mean colour of the nearest others, without view dependence, in place."""
    if hidden.all() or not hidden.any():
        return
    means, sh0 = part.params["means"], part.params["sh0"]
    found = _nearest_means(means[~hidden], sh0[~hidden].flatten(1), means[hidden], NEIGHBOURS["gaussian"])
    sh0[hidden] = found.reshape(-1, *sh0.shape[1:])
    part.params["shN"][hidden] = 0.0


class _TexelColors:
    """Sums over images for the n texels of a cube map: squared transmittance in texel areas (n, 1), and of pixels that
    show the static scene their colours and number (n, 4)."""

    def __init__(self, sky: CubemapSky):
        self._sky = sky
        self._texels = sky.params["texels"]
        self._through = torch.zeros_like(self._texels[:, :1])
        self._sums = torch.zeros(len(self._texels), 4).to(self._texels)

    def add(self, model: SplatModel, view: TrainingView, shown: _Shown) -> None:
        alpha, seen_from = shown.alpha, model.seen_from(view.view)
        unmasked = torch.ones_like(alpha)
        for mask in (view.ego_mask, view.moving):
            unmasked = unmasked if mask is None else unmasked * ~mask[..., None]
        background = unmasked * shown.static[..., None]
        colors = self._sky.behind(shown.splats, alpha, seen_from)
        values = torch.cat([unmasked * (1.0 - alpha).square(), background * colors, background], dim=-1)
        found = self._sky.sums(seen_from.rays(), values)
        self._through += found[:, :1] / self._texel_area(view)
        self._sums += found[:, 1:]

    def fill(self) -> None:
        """Replaces the colours of unseen texels."""
        known = self._sums[:, 3] > MIN_PIXELS
        if not known.any():
            return
        means, directions = self._sums[:, :3] / self._sums[:, 3:].clamp(min=1e-12), self._sky.directions()
        at = torch.nn.functional.normalize(directions, dim=1)
        means[~known] = _nearest_means(at[known], means[known], at[~known], NEIGHBOURS["texel"])
        kept = self._through.square() / (self._through.square() + SEEN**2)
        self._texels.copy_(torch.lerp(logit_of(means), self._texels, kept))

    def _texel_area(self, view: TrainingView) -> float:
        """The pixels of an image that a texel in the middle of a face covers."""
        width = 2.0 / (self._sky.index.shape[-1] - 1)
        return float(view.view.K[0, 0] * view.view.K[1, 1]) * width**2


def _nearest_means(
    places: Float[Tensor, "n 3"], values: Float[Tensor, "n v"], wanted: Float[Tensor, "m 3"], neighbours: int
) -> Float[Tensor, "m v"]:
    """The means of the `values` of the nearest of `places`, by inverse square distance, at the places `wanted`.

    Both are searched in Morton order: what is near is then near in memory, too.
    """
    of_places, of_wanted = morton_order(places), morton_order(wanted)
    tree = cKDTree(places[of_places].cpu().numpy(), compact_nodes=False, balanced_tree=False)
    count = np.arange(1, min(neighbours, len(places)) + 1)
    distances, nearest = tree.query(wanted[of_wanted].cpu().numpy(), k=count, workers=torch.get_num_threads())
    weights = 1.0 / (distances**2 + 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    means = np.einsum("mk,mkv->mv", weights, values[of_places].cpu().numpy()[nearest])
    found = torch.empty(len(wanted), values.shape[1], dtype=values.dtype, device=values.device)
    found[of_wanted] = torch.from_numpy(means).to(values)
    return found
