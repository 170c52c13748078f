"""The colour of the ground about an object, which says how bright a drive is recorded there."""

import numpy as np
import torch
from jaxtyping import Float

from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.splat_model import SplatModel

REACH, LAYER = 12.0, 0.3
"""Metres about an object, and above and below its floor, within which static Gaussians are the ground about it."""
MIN_GAUSSIANS, MIN_OPACITY = 50, 0.3
"""The ground is known from so many Gaussians of at least this opacity."""
MAX_GAIN, MIN_CHANGE = 1.6, 0.1
"""The largest factor by which colours are matched, and one divided by it the smallest; and the least change."""


@torch.no_grad()
def ground_color(
    model: SplatModel, time: float, object_to_world: Float[np.ndarray, "4 4"], height: float
) -> Float[np.ndarray, "3"] | None:
    """The median colour, RGB in [0, 1], of the ground about an object of this height (metres) at a pose and a time;
    None where it is not known."""
    pose, found = torch.from_numpy(object_to_world).float(), []
    for part in model.parts:
        if part.has_objects or part.moves:
            continue
        own = part.sample(part.state(time))
        placed = pose.to(own.means)
        local = (own.means - placed[:3, 3]) @ placed[:3, :3]
        near = (local[:, :2].norm(dim=1) < REACH) & ((local[:, 2] + height / 2.0).abs() < LAYER)
        found.append(0.5 + SH_C0 * own.sh0[near & (own.opacities > MIN_OPACITY), 0])
    colors = torch.cat(found) if found else torch.zeros(0, 3)
    return colors.median(dim=0).values.double().cpu().numpy() if len(colors) >= MIN_GAUSSIANS else None


def matching_gains(
    recorded: Float[np.ndarray, "3"] | None, here: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "3"] | None:
    """The factors of red, green and blue that make ground that was `recorded` in one drive as bright as it is `here`,
    at most MAX_GAIN; None where one is not known, and where all are within MIN_CHANGE of 1, as the colours of two
    pieces of one road are."""
    if recorded is None or here is None or min(*recorded, *here) <= 0.0:
        return None
    gains = np.clip(here / recorded, 1.0 / MAX_GAIN, MAX_GAIN)
    return None if (np.abs(gains - 1.0) < MIN_CHANGE).all() else gains
