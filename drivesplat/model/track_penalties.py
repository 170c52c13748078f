"""The penalties of learned corrections of tracks, in few tensor operations, which every training iteration runs."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.constants import constant
from drivesplat.settings.train import TrackSettings


def track_penalties(
    translation: Float[Tensor, "m 3"], yaw: Float[Tensor, " m"], neighbours: Int[Tensor, "q 3"], settings: TrackSettings
) -> dict[str, Float[Tensor, ""]]:
    """The penalties of corrections: their mean square, and that of their second differences along the tracks, both in
    units of the expected annotation error. `neighbours` are all triples of consecutive annotations."""
    sigmas = (settings.sigma_translation,) * 3 + (settings.sigma_yaw,)
    off = torch.cat([translation, yaw[:, None]], dim=1) / constant(sigmas, yaw.device)
    penalties = {"track_size": settings.size_weight / max(1, len(off)) * _sum_of_squares(off)}
    if len(neighbours):
        threes = off.index_select(0, neighbours.flatten()).reshape(-1, 3, 4)
        bends = (threes * constant((1.0, -2.0, 1.0), yaw.device)[:, None]).sum(dim=1)
        penalties["track_bend"] = settings.bend_weight / len(neighbours) * _sum_of_squares(bends)
    return penalties


def _sum_of_squares(values: Float[Tensor, "n 4"]) -> Float[Tensor, ""]:
    return values.flatten().dot(values.flatten())
