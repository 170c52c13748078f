"""The terms of the training loss, each named, so that each can be logged and blamed."""

import dataclasses

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drivesplat.masks import UNLABELLED
from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.settings.train import TrainSettings
from drivesplat.training.ssim import ssim
from drivesplat.training.views import LidarDepth, TrainingView

WORST = 0.05
"""The share of depths that the loss leaves out."""


def loss_terms(
    picture: Picture, view: TrainingView, model: SplatModel, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted terms whose sum is minimised; what is absent from the picture is not regularised either, since
    nothing in it could hold against that. Of what the own car's body hides nothing is asked."""
    target, shown = view.target(), picture.gaussians
    if view.own_car is not None:
        picture = behind(view.own_car, picture, target)
    terms = {
        "l1": (1.0 - settings.ssim_weight) * F.l1_loss(picture.image, target),
        "ssim": settings.ssim_weight * (1.0 - ssim(picture.image, target)),
    }
    if settings.opacity_reg:
        terms["opacity_reg"] = settings.opacity_reg * shown.opacities.mean()
    if settings.scale_reg:
        there = shown.opacities.detach() > 0.0
        terms["scale_reg"] = settings.scale_reg * (shown.scales * there[:, None]).mean()
    if view.sky is not None and model.sky is not None and model.sky.keeps_gaussians_out:
        terms["sky_alpha"] = settings.sky_alpha_weight * sky_alpha_loss(picture.alpha, view.sky)
    if view.sky is not None and settings.sky_bce_weight:
        terms["sky_bce"] = settings.sky_bce_weight * sky_cross_entropy(picture.alpha, view.sky)
    if view.lidar is not None and picture.depth is not None:
        terms["depth"] = settings.depth_weight * depth_loss(picture.depth, view.lidar)
    logits = model.class_logits(picture, view.view) if view.classes is not None else None
    if logits is not None:
        terms["semantic"] = settings.semantic_weight * class_cross_entropy(logits, view.classes)
    for name, learned in (("exposure", model.exposure), ("camera_poses", model.camera_poses)):
        paid = learned.penalty(view.view.camera) if learned is not None else None
        if paid is not None:
            terms[name] = paid
    return {**terms, **_moving_terms(picture, target, view, model, settings)}


def behind(own_car: Bool[Tensor, "h w"], picture: Picture, target: Float[Tensor, "h w 3"]) -> Picture:
    """The picture with the own car's body before it: there it is as it was recorded, and opaque.

    So nothing in the picture is pulled by these pixels. A window of SSIM that reaches over the body's edge finds both
    images alike beyond it and judges by the rest, and every other pixel weighs what it does in an image without a body.
    Were the target made like the picture instead, such windows would still pull on what lies behind the body.
    """
    image = torch.where(own_car[..., None], target, picture.image)
    return dataclasses.replace(picture, image=image, alpha=picture.alpha.masked_fill(own_car, 1.0))


def _moving_terms(
    picture: Picture, target: Float[Tensor, "h w 3"], view: TrainingView, model: SplatModel, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The terms about parts that move; none for a model without."""
    terms = {name: term for part in model.parts for name, term in part.penalties().items()}
    alpha = model.objects_alpha(picture, view.view) if settings.entropy_weight else None
    if alpha is not None:
        seen = alpha if view.own_car is None else alpha.masked_fill(view.own_car, 1.0)
        terms["entropy"] = settings.entropy_weight * entropy(seen)
    if view.moving is not None and settings.dynamic_weight:
        terms["dynamic"] = settings.dynamic_weight * masked_l1(picture.image, target, view.moving)
    return terms


def sky_cross_entropy(alpha: Float[Tensor, "h w"], sky: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean binary cross entropy between alpha and the absence of sky."""
    return F.binary_cross_entropy(alpha.clamp(1e-4, 1.0 - 1e-4), 1.0 - sky.float())


def class_cross_entropy(logits: Float[Tensor, "h w c"], classes: UInt8[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean over the labelled pixels of -log of the softmax of the class that is there (Street Gaussians, section 3.3);
    0 where no pixel is labelled."""
    flat = classes.reshape(-1).long()
    total = F.cross_entropy(logits.reshape(len(flat), -1), flat, ignore_index=UNLABELLED, reduction="sum")
    return total / (flat != UNLABELLED).sum().clamp(min=1)


def depth_loss(depth: Float[Tensor, "h w"], lidar: LidarDepth) -> Float[Tensor, ""]:
    """Mean absolute difference in metres where LiDAR measured, the worst 5 % left out (Street Gaussians, section 3.3):
    returns from behind an edge, or from what the image does not see."""
    errors = (depth.reshape(-1)[lidar.pixels] - lidar.depth).abs()
    kept = max(1, int(len(errors) * (1.0 - WORST)))
    return torch.topk(errors, kept, largest=False, sorted=False).values.mean()


def entropy(alpha: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean of -o ln o - (1 - o) ln (1 - o): least where everything is there or not there."""
    o = alpha.clamp(1e-4, 1.0 - 1e-4)
    return -(o * torch.log(o) + (1.0 - o) * torch.log1p(-o)).mean()


def masked_l1(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference over a mask; 0 for an empty one."""
    difference = (image - target).abs().mean(dim=-1) * mask
    return difference.sum() / mask.sum().clamp(min=1)


def sky_alpha_loss(alpha: Float[Tensor, "h w"], sky: Tensor) -> Float[Tensor, ""]:
    """Mean over the image of -log(1 - alpha) on sky pixels: the half of the cross entropy that empties the sky."""
    return (-torch.log((1.0 - alpha).clamp(min=1e-4)) * sky).mean()
