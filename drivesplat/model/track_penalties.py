"""The penalties of learned corrections of tracks."""

from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.track_penalties import sums_of_squares
from drivesplat.settings.train_objects import TrackSettings


def track_penalties(
    translation: Float[Tensor, "m 3"], yaw: Float[Tensor, " m"], neighbours: Int[Tensor, "q 3"], settings: TrackSettings
) -> dict[str, Float[Tensor, ""]]:
    """The penalties of corrections: their mean square, and that of their second differences along the tracks, both in
    units of the expected annotation error. `neighbours` are all triples of consecutive annotations."""
    size, bend = sums_of_squares(translation, yaw, neighbours, settings.sigma_translation, settings.sigma_yaw)
    penalties = {"track_size": settings.l2_weight / max(1, len(yaw)) * size}
    if len(neighbours):
        penalties["track_bend"] = settings.smoothness_weight / len(neighbours) * bend
    return penalties
