"""Gaussians as a LiDAR sees them, and what their projection into a scan depends on."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

MIN_ALPHA = 1.0 / 255.0
"""Minimum alpha: smaller contributions are not drawn."""
MIN_RANGE = 0.2
"""Gaussians nearer to the sensor (metres) are skipped."""
SINE_OF_POLES = math.sin(math.radians(80.0))
"""Gaussians nearer to the poles, by the sine of their elevation, are skipped: azimuths, and so the linearisation,
degenerate there."""
MAX_DEVIATIONS = 3.0
"""Maximum correction of the range within a Gaussian, in standard deviations of the range along its plane within its
footprint, which the beams widen. Standard deviations of its own range alone would cut off the plane of the road, where
beams graze it, and shift it towards the sensor."""
MIN_SINE_SQUARED = 1e-8
"""Gaussians seen as a line, where the squared sine between a and e is smaller, have no slope."""
FIRING_STEPS = 4
"""Iterations to find the time at which a moving Gaussian meets the spinning beams; each reduces the error by the ratio
of the Gaussian's angular velocity to the sensor's."""


class ScannedGaussians(NamedTuple):
    """n Gaussians as a LiDAR sees them: `means2d`, azimuth and elevation in radians; `ranges` in metres; `conics`, the
    upper triangles of inverse covariances of azimuth and elevation; `slopes`, metres of range by radian of azimuth and
    of elevation, which correct the range of a ray by at most `range_limits` metres; `radii`, the reach in radians, 0
    for Gaussians that are skipped; `opacities`."""

    means2d: Float[Tensor, "n 2"]
    ranges: Float[Tensor, " n"]
    conics: Float[Tensor, "n 3"]
    slopes: Float[Tensor, "n 2"]
    range_limits: Float[Tensor, " n"]
    radii: Float[Tensor, "n 2"]
    opacities: Float[Tensor, " n"]


PROJECTED = ((2,), (), (3,), (2,), (), (2,))
"""The shapes of the fields of a Gaussian that its projection gives: all but its opacity."""
LEARNED = PROJECTED[:4]
"""The shapes of those that gradients reach: means, ranges, conics and slopes."""


class FiringTimes(NamedTuple):
    """When each azimuth fires: the azimuths `between` neighbouring firings of revolution after revolution (radians,
    ascending), a + 1 of them, and the `offsets_s` of the a + 2 firings around them."""

    between: Float[Tensor, " c"]
    offsets_s: Float[Tensor, " d"]

    @classmethod
    def of(cls, azimuths: Float[Tensor, " a"], offsets_s: Float[Tensor, " a"]) -> "FiringTimes":
        """Those of a firings, by their azimuths (radians, ascending within ±π) and times."""
        first, last, turn = slice(0, 1), slice(-1, None), 2.0 * math.pi
        around = torch.cat([azimuths[last] - turn, azimuths, azimuths[first] + turn])
        return cls(0.5 * (around[1:] + around[:-1]), torch.cat([offsets_s[last], offsets_s, offsets_s[first]]))


class Revolution(NamedTuple):
    """The motion while a sensor's beams revolve: when which azimuth fires; the velocity (m/s) and the angular velocity
    (rad/s) of the sensor in its own frame at the timestamp; and the velocities (m/s) of Gaussians in the world."""

    firings: FiringTimes
    linear: Float[Tensor, "3"]
    angular: Float[Tensor, "3"]
    velocities: Float[Tensor, "n 3"] | None


def wrapped(angles: Tensor) -> Tensor:
    """Angles in radians within ±π."""
    return angles - 2.0 * math.pi * torch.round(angles / (2.0 * math.pi))
