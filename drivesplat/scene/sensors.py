"""Cameras and LiDARs, and what a LiDAR returns."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

DistortionModel = Literal["none", "opencv", "fisheye", "angle_to_radius", "radius_to_angle", "mei"]


@dataclass(frozen=True)
class Camera:
    """A camera. `width`, `height` in pixels; `intrinsics`, OpenCV (integer coordinates at pixel centres);
    `distortion`: coefficients of `distortion_model` (`scene/lens.py`), all 0 for rectified images; `readout_s`: time in
    seconds from the first line of pixels to the last, read in `readout_direction`. None if unknown."""

    name: str
    width: int
    height: int
    intrinsics: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, " k"] | None = None
    readout_s: float | None = None
    readout_direction: Literal["down", "up", "left", "right"] | None = None
    distortion_model: DistortionModel = "none"


@dataclass(frozen=True)
class Spin:
    """How a LiDAR goes round: a revolution takes `revolution_s` seconds and begins `start_s` seconds after the sweep's
    timestamp at the azimuth `start_azimuth` (radians), clockwise seen from above or not."""

    revolution_s: float
    start_s: float
    start_azimuth: float
    clockwise: bool = True

    def fractions(self, azimuths: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """The fractions of a revolution after which the beams pass azimuths."""
        turned = self.start_azimuth - azimuths if self.clockwise else azimuths - self.start_azimuth
        return turned / (2.0 * np.pi) % 1.0

    def offsets_s(self, azimuths: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Seconds after the sweep's timestamp at which the beams pass azimuths."""
        return self.start_s + self.revolution_s * self.fractions(azimuths)


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR. `beam_elevations` in radians above the sensor's horizontal plane, in ring order;
    `azimuth_steps` is the number of firings of a beam per revolution; `spin` gives the times of returns that have none
    of their own. None if unknown."""

    name: str
    beam_elevations: Float64[np.ndarray, " b"] | None = None
    azimuth_steps: int | None = None
    spin: Spin | None = None


@dataclass(frozen=True)
class SweepMotion:
    """The motion of a LiDAR during a sweep whose points are in the sensor's frame at their own times. `ego_to_sweep`:
    the ego frame at k increasing `offsets_s`, seconds after the sweep's timestamp, in the sensor's frame at that
    timestamp; position is linear and rotation slerp in between. `sensor_to_ego` is the mount."""

    offsets_s: Float64[np.ndarray, " k"]
    ego_to_sweep: Float64[np.ndarray, "k 4 4"]
    sensor_to_ego: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class LidarReturns:
    """The n returns of a sweep. `points` (n, 3) float64, metres, in the sensor's frame at the sweep's timestamp.

    None if the file has no such column: `intensity` (n,) float32 in [0, 1]; `rings` (n,) int64, indices of
    `Lidar.beam_elevations`; `offsets_s` (n,) float64, seconds after the sweep's timestamp.
    """

    points: np.ndarray
    intensity: np.ndarray | None = None
    rings: np.ndarray | None = None
    offsets_s: np.ndarray | None = None
