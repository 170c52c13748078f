"""What a training knows of its scene beside the images, and the terms of the loss that hold surfaces to be what they
are: flat, and where the road is."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.part import active_fraction
from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings
from drivesplat.training.cells import Cells
from drivesplat.training.road import Road, road_loss, road_of


@dataclass(frozen=True)
class Surroundings:
    """What is known of a scene beside its images, None where nothing is or where it is not wanted: the `free` space
    that rays prove empty, and the `road`."""

    free: Cells | None = None
    road: Road | None = None

    def to(self, device: torch.device) -> "Surroundings":
        return Surroundings(*(None if known is None else known.to(device) for known in (self.free, self.road)))


NOTHING_KNOWN = Surroundings()


def surroundings_of(record: TrainingRecord, free_space: dict[str, Any] | None, settings: TrainSettings) -> Surroundings:
    """What `settings` want to know, on the CPU, from the records of parser.pkl and of free_space.pkl (None: not
    made)."""
    grid = {name: free_space[name] for name in ("lower", "shape", "keys")} if free_space else {}
    return Surroundings(
        Cells.of(edge=free_space["voxel"], **grid) if free_space else None,
        road_of(record, settings.road) if settings.road_weight else None,
    )


def surface_terms(
    picture: Picture, model: SplatModel, surroundings: Surroundings, settings: TrainSettings
) -> dict[str, Float[Tensor, ""]]:
    """The weighted terms about the surfaces of what stands still."""
    if not settings.flatness_weight and surroundings.road is None:
        return {}
    parts = [(part, rows) for part, rows in zip(model.parts, model.rows, strict=True) if not part.moves]
    still = concatenate([picture.gaussians[rows] for _, rows in parts])
    terms = {}
    if settings.flatness_weight:
        terms["flatness"] = settings.flatness_weight * thickness(still) / active_fraction([part for part, _ in parts])
    if surroundings.road is not None:
        terms["road"] = settings.road_weight * road_loss(still, surroundings.road)
    return terms


def thickness(gaussians: Gaussians) -> Float[Tensor, ""]:
    """Mean of the smallest scale in metres, 0 for Gaussians that are discs: the regulariser of NeuSG (Chen et al. 2023,
    arXiv 2312.00846) and PGSR (Chen et al. 2024, arXiv 2406.06521)."""
    return gaussians.scales.min(dim=1).values.mean()
