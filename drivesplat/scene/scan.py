"""One revolution of a LiDAR as rays: where each points, when it fires, and what it returned.

Angles are in the sensor's own axes at the ray's own time: azimuth = atan2(y, x), elevation = asin(z / range), radians.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32


@dataclass(frozen=True)
class ScanRays:
    """The rays of b beams and a firings, neighbours side by side: `azimuths` within ±π and `elevations`, radians in the
    sensor's frame at the ray's own time; `offsets_s`, seconds after the sweep's timestamp."""

    azimuths: Float32[np.ndarray, "b a"]
    elevations: Float32[np.ndarray, "b a"]
    offsets_s: Float32[np.ndarray, "b a"]

    @property
    def shape(self) -> tuple[int, int]:
        """Beams and firings."""
        return self.azimuths.shape

    @property
    def beam_elevations(self) -> Float32[np.ndarray, " b"]:
        """The median elevation of each beam, radians."""
        return np.median(self.elevations, axis=1)

    def directions(self) -> Float32[np.ndarray, "b a 3"]:
        """Unit vectors in the sensor's frame at each ray's own time."""
        flat = np.cos(self.elevations)
        return np.stack([flat * np.cos(self.azimuths), flat * np.sin(self.azimuths), np.sin(self.elevations)], axis=-1)


@dataclass(frozen=True)
class Scan:
    """A recorded revolution. `returned`: whether a ray has a return; `ranges` in metres from the sensor's position at
    the ray's own time, and `intensities` in [0, 1], None if the sensor records none: 0 without a return."""

    rays: ScanRays
    returned: Bool[np.ndarray, "b a"]
    ranges: Float32[np.ndarray, "b a"]
    intensities: Float32[np.ndarray, "b a"] | None = None

    def points(self) -> Float32[np.ndarray, "n 3"]:
        """The returns, beam by beam, in the sensor's frame at their own times."""
        return self.rays.directions()[self.returned] * self.ranges[self.returned, None]


@dataclass(frozen=True)
class RenderedScan:
    """What a method says that the rays of a recorded scan return: `ranges` in metres, `drops`, the probability of no
    return, and `intensities` in [0, 1], None where the method has none."""

    ranges: Float[np.ndarray, "b a"]
    drops: Float[np.ndarray, "b a"]
    intensities: Float[np.ndarray, "b a"] | None = None

    @property
    def returned(self) -> Bool[np.ndarray, "b a"]:
        """The rays that more probably return than not."""
        return (self.drops < 0.5) & (self.ranges > 0.0)


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Angles in radians from -π to below π, in their own type."""
    return (angles + np.pi) % (2.0 * np.pi) - np.pi
