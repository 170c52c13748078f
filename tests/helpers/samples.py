"""The Gaussians of a part at a time."""

from collections.abc import Iterable
from dataclasses import replace

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Part
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, ActorPlacement, Want

EVERYTHING = Want(velocities=True, lidar=True)


def sampled(part: Part, time: float, want: Want = IMAGE) -> Gaussians:
    """Its Gaussians in world coordinates."""
    return part.sample(part.state(time, want), want)


def sampled_with(
    model: SplatModel | Part, time: float, placements: Iterable[ActorPlacement], want: Want = IMAGE
) -> Gaussians:
    """The Gaussians of a model, or of a part, with objects at placements and no others."""
    there = replace(want, placements=tuple(placements))
    return model.at(time, there) if isinstance(model, SplatModel) else sampled(model, time, there)
