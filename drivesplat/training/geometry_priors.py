"""Geometry known beside the images, free space and road, and the loss terms of surfaces: flatness and road."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.regularizers import mean_thickness
from drivesplat.kernels.road_distance import Road, road_distance
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.lidar.free_space_record import FreeSpace
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import active_fraction
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings
from drivesplat.training.losses import Means, weighted
from drivesplat.training.road import road_of


@dataclass(frozen=True)
class GeometryPriors:
    """Geometry of a scene known beside its images: `free` space that LiDAR rays crossed, and the `road`; each None
    where it is unknown or not wanted."""

    free: SparseGrid | None = None
    road: Road | None = None

    def to(self, device: torch.device) -> "GeometryPriors":
        return GeometryPriors(*(None if prior is None else prior.to(device) for prior in (self.free, self.road)))


NO_PRIORS = GeometryPriors()


def geometry_priors(record: TrainingRecord, space: FreeSpace | None, settings: TrainSettings) -> GeometryPriors:
    """The priors that `settings` want, on the CPU, from the training record and the record of free `space` (None: not
    made). Without training images the road is unknown."""
    return GeometryPriors(
        SparseGrid.from_numpy(space.lower, space.voxel, space.shape, space.keys) if space else None,
        road_of(record, settings.road) if settings.road_weight and len(record.train_images) else None,
    )


def geometry_terms(
    sets: Sequence[Gaussians],
    model: SplatModel,
    priors: GeometryPriors,
    settings: TrainSettings,
    from_road: Float[Tensor, ""] | None = None,
) -> dict[str, Float[Tensor, ""]]:
    """The weighted loss terms of the surfaces of static parts, from the `sets` of Gaussians of all parts at one time.
    `from_road` is the distance of these sets from the road of `priors`, None where it is not known yet."""
    if not settings.flatness_weight and priors.road is None:
        return {}
    parts = [(part, own) for part, own in zip(model.parts, sets, strict=True) if not part.moves]
    static = concatenate([own for _, own in parts])
    terms: Means = {}
    if settings.flatness_weight:
        thickness = mean_thickness(static.scales) / active_fraction([part for part, _ in parts])
        terms["flatness"] = settings.flatness_weight, thickness
    if priors.road is not None:
        distance = road_loss(static, priors.road) if from_road is None else from_road
        terms["road"] = settings.road_weight, distance
    return weighted(terms)


def road_loss(gaussians: Gaussians, road: Road) -> Float[Tensor, ""]:
    """The weighted mean distance in metres of the road's Gaussians from its surface: see `road_distance`."""
    return road_distance(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, road)
