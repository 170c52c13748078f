"""The terms of the training loss, by name, for logs and error messages."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from drivesplat.kernels.alpha_entropy import mean_cross_entropy, mean_entropy
from drivesplat.kernels.color_difference import color_difference
from drivesplat.kernels.constants import constant
from drivesplat.kernels.depth_error import mean_depth_error
from drivesplat.kernels.regularizers import mean_opacity_and_scale, mean_thickness
from drivesplat.kernels.road_distance import Road, road_distance
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import active_fraction
from drivesplat.model.picture import Picture
from drivesplat.model.scans import ScanPicture
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.masks import UNLABELLED
from drivesplat.settings.train import TrainSettings
from drivesplat.training.views import LidarDepth, TrainingView

Terms = dict[str, Float[Tensor, ""]]
"""The weighted terms of a loss, by name."""
Means = dict[str, tuple[float, Float[Tensor, ""]]]
"""Weights and means of the terms of a loss, by name."""
MIN_DEPTH = 1.0
"""Metres: nearer depths count as this where their inverse is compared."""
MAX_CURVATURE, EDGE_DECAY, OPAQUE = 0.1, 10.0, 0.8
"""Of `depth_roughness`: the relative second difference of inverse depth as which larger ones count, the decay of
weights per unit of brightness in [0, 1], and the alpha that pixels must exceed."""


def loss_terms(
    picture: Picture, view: TrainingView, model: SplatModel, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted terms whose sum is minimised. Gaussians that are absent at the view's time are not regularised,
    since the image could not counteract. Pixels of the ego vehicle have no effect."""
    alpha = picture.alpha if view.ego_mask is None else picture.alpha.masked_fill(view.ego_mask, 1.0)
    moving = view.moving if settings.dynamic_weight > 0 else None
    difference = color_difference(picture.image, view.pixels, view.ego_mask, moving)
    terms: Means = {
        "l1": (1.0 - settings.ssim_weight, difference.l1),
        "ssim": (settings.ssim_weight, 1.0 - difference.ssim),
    }
    if difference.moving_l1 is not None:
        terms["dynamic"] = settings.dynamic_weight, difference.moving_l1
    terms |= regularization(picture, model, settings)
    if view.sky is not None and model.sky is not None and model.sky.keeps_gaussians_out:
        terms["sky_alpha"] = settings.sky_alpha_weight, sky_alpha_loss(alpha, view.sky)
    if view.sky is not None and settings.sky_bce_weight:
        terms["sky_bce"] = settings.sky_bce_weight, mean_cross_entropy(alpha, view.sky)
    if view.not_sky is not None and settings.horizon_weight:
        certain = alpha.masked_fill(~view.not_sky, 1.0)
        terms["horizon"] = settings.horizon_weight, mean_cross_entropy(certain, torch.zeros_like(view.not_sky))
    if view.lidar is not None and picture.depth is not None:
        terms["depth"] = settings.depth_weight, depth_loss(picture.depth, view.lidar)
    if picture.depth is not None and settings.smoothness_weight:
        opaque = picture.alpha if view.ego_mask is None else picture.alpha.masked_fill(view.ego_mask, 0.0)
        terms["smoothness"] = settings.smoothness_weight, depth_roughness(picture.depth, opaque, view.target())
    if view.classes is not None and all("classes" in part.params for part in model.parts):
        logits = torch.cat([part.params["classes"] for part in model.parts])
        rendered = model.composited(picture.shapes, logits, view.view).image.squeeze(0)
        terms["semantic"] = settings.semantic_weight, class_cross_entropy(rendered, view.classes)
    penalty = model.exposure.penalty(view.view.camera) if model.exposure is not None else None
    if penalty is not None:
        terms["exposure"] = 1.0, penalty
    return weighted({**terms, **_dynamic_terms(picture, view, model, settings)})


def weighted(terms: Means) -> dict[str, Float[Tensor, ""]]:
    """The products of weights and means, by one operation for all of them."""
    if not terms:
        return {}
    weights, means = zip(*terms.values(), strict=True)
    products = torch.stack(means) * constant(weights, means[0].device)
    return dict(zip(terms, products.unbind(), strict=True))


def regularization(picture: Picture | ScanPicture, model: SplatModel, settings: TrainSettings) -> Means:
    """The mean opacity and scale (metres) of a model's Gaussians in a picture, with their weights."""
    weights = {"opacity_reg": settings.opacity_reg, "scale_reg": settings.scale_reg}
    if not any(weights.values()):
        return {}
    known = picture.sets if picture.sets.are_apart else [picture.sets.shapes]  # copying all of them would take time
    means, active = mean_opacity_and_scale(*((it.opacities, it.scales) for it in known)), active_fraction(model.parts)
    return {name: (w, mean / active) for (name, w), mean in zip(weights.items(), means, strict=True) if w}


def _dynamic_terms(picture: Picture, view: TrainingView, model: SplatModel, settings: TrainSettings) -> Means:
    """The terms of dynamic parts, colours excepted; none for a model without such parts. Penalties of one
    name are added over the parts."""
    terms: Means = {}
    for part in model.parts:
        for name, penalty in part.penalties().items():
            terms[name] = 1.0, terms[name][1] + penalty if name in terms else penalty
    alpha = model.objects_alpha(picture, view.view) if settings.entropy_weight else None
    if alpha is not None:
        seen = alpha if view.ego_mask is None else alpha.masked_fill(view.ego_mask, 1.0)
        terms["entropy"] = settings.entropy_weight, mean_entropy(seen)
    return terms


def surface_terms(
    sets: Sequence[Gaussians], model: SplatModel, road: Road | None, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted loss terms of the surfaces of static parts, from the `sets` of Gaussians of all parts at one
    time."""
    road = road if settings.road_weight else None
    if not settings.flatness_weight and road is None:
        return {}
    parts = [(part, own) for part, own in zip(model.parts, sets, strict=True) if not part.moves]
    static = concatenate([own for _, own in parts])
    terms: Means = {}
    if settings.flatness_weight:
        thickness = mean_thickness(static.scales) / active_fraction([part for part, _ in parts])
        terms["flatness"] = settings.flatness_weight, thickness
    if road is not None:
        distance = road_distance(static.means, static.quats, static.scales, static.opacities, road)
        terms["road"] = settings.road_weight, distance
    return weighted(terms)


def class_cross_entropy(logits: Float[Tensor, "h w c"], classes: UInt8[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean cross entropy over the labelled pixels (Street Gaussians, section 3.3); 0 where no pixel is labelled."""
    flat = classes.reshape(-1).long()
    total = F.cross_entropy(logits.reshape(len(flat), -1), flat, ignore_index=UNLABELLED, reduction="sum")
    return total / (flat != UNLABELLED).sum().clamp(min=1)


def depth_loss(depth: Float[Tensor, "h w"], lidar: LidarDepth) -> Float[Tensor, ""]:
    """Mean absolute difference to the LiDAR depths in metres, without the largest 5 % (Street Gaussians, section 3.3):
    these are returns from behind an edge, or of surfaces that the image does not show."""
    return mean_depth_error(depth, lidar.pixels, lidar.depth, lidar.count)


def depth_roughness(
    depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"], image: Float[Tensor, "h w 3"]
) -> Float[Tensor, ""]:
    """How uneven the surfaces of a depth image (metres) are: the absolute second difference of inverse depth between
    neighbouring pixels, divided by inverse depth. The sum of its means along rows and along columns.

    Inverse depth of a plane is a linear function of the pixel, whatever its slope. Pixels weigh exp(-EDGE_DECAY d) with
    d the difference of brightness between both neighbours, after Godard et al. (2017, arXiv 1609.03677, equation 3):
    where colours change a surface may end. Differences above MAX_CURVATURE count as that, so that edges of objects stay
    as they are; pixels with an `alpha` of at most OPAQUE, of themselves or of a neighbour, do not count.
    """
    inverse, brightness, opaque = 1.0 / depth.clamp(min=MIN_DEPTH), image.mean(dim=2), alpha.detach() > OPAQUE
    total = depth.new_zeros(())
    for axis in (0, 1):
        count = depth.shape[axis] - 2
        if count < 1:
            continue
        before, at, after = (inverse.narrow(axis, start, count) for start in range(3))
        curvature = ((before - 2.0 * at + after) / at.detach()).abs().clamp(max=MAX_CURVATURE)
        edge = (brightness.narrow(axis, 2, count) - brightness.narrow(axis, 0, count)).abs()
        inside = opaque.narrow(axis, 0, count) & opaque.narrow(axis, 1, count) & opaque.narrow(axis, 2, count)
        total = total + (curvature * torch.exp(-EDGE_DECAY * edge) * inside).mean()
    return total


def sky_alpha_loss(alpha: Float[Tensor, "h w"], sky: Tensor) -> Float[Tensor, ""]:
    """Mean over the image of -log(1 - alpha) on sky pixels: the part of the cross entropy that removes Gaussians from
    the sky."""
    return (-torch.log((1.0 - alpha).clamp(min=1e-4)) * sky).mean()
