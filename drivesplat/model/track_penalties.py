"""The penalties of learned corrections of tracks."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.settings.train import TrackSettings


def track_penalties(
    translation: Float[Tensor, "m 3"], yaw: Float[Tensor, " m"], neighbours: Int[Tensor, "q 3"], settings: TrackSettings
) -> dict[str, Float[Tensor, ""]]:
    """The penalties of corrections: their mean square, and that of their second differences along the tracks, both in
    units of the expected annotation error. `neighbours` are all triples of consecutive annotations."""
    off = torch.cat([translation / settings.sigma_translation, yaw[:, None] / settings.sigma_yaw], dim=1)
    penalties = {"track_size": settings.size_weight * off.square().sum(dim=1).mean()}
    if len(neighbours):
        before, here, after = off[neighbours].unbind(dim=1)
        penalties["track_bend"] = settings.bend_weight * (before - 2.0 * here + after).square().sum(dim=1).mean()
    return penalties
