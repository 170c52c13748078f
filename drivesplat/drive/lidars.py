"""LiDARs that a drive is scanned with: recorded ones, and patterns of the user."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from drivesplat.drive.cameras import Vector, require_pose, require_vector
from drivesplat.errors import RequestError
from drivesplat.lidar.moved_sensor import moved
from drivesplat.lidar.scans import SensorPoses
from drivesplat.scene.scan import Scan, ScanRays, wrapped
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan

MAX_RAYS = 20_000_000
"""Rays of a pattern; more are a mistake in its numbers."""


@dataclass(frozen=True, eq=False)
class PoseableLidar:
    """A spinning LiDAR.

    `rays` are the directions and times of its beams and firings (`drivesplat.scene.scan.ScanRays`: x forward, y left, z
    up in the sensor's axes, seconds from the scan's time). `sensor_to_ego` is its mount on the ego vehicle, None for a
    LiDAR that is always placed by its own pose. `blocked` rays never return: the vehicle is in their way. `beam_spread`
    are the standard deviations of a beam's footprint in azimuth and elevation in radians; None: as the model was
    trained. Raises RequestError for an invalid mount.

    >>> lidar = PoseableLidar.spinning(np.radians(np.linspace(-25.0, 15.0, 64)), azimuth_steps=1800)
    >>> lidar.rays.shape
    (64, 1800)
    """

    rays: ScanRays
    sensor_to_ego: Float64[np.ndarray, "4 4"] | None = None
    blocked: Bool[np.ndarray, "b a"] | None = None
    beam_spread: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.sensor_to_ego is not None:
            object.__setattr__(self, "sensor_to_ego", require_pose(self.sensor_to_ego, "the LiDAR's mount"))
        if self.beam_spread is not None:
            spread = require_vector(self.beam_spread, 2, "beam_spread")
            if not ((spread > 0.0) & (spread < 0.1)).all():
                raise RequestError(f"a beam_spread of {self.beam_spread} rad is no LiDAR's: it is about 0.0003")

    @classmethod
    def spinning(
        cls,
        beam_elevations: Vector,
        azimuth_steps: int,
        revolution_s: float = 0.1,
        sensor_to_ego: np.ndarray | None = None,
        clockwise: bool = True,
        beam_spread: tuple[float, float] | None = None,
    ) -> "PoseableLidar":
        """A LiDAR whose beams (radians above the sensor's horizontal plane) fire together at evenly spaced azimuths.
        A revolution begins and ends behind the sensor; the scan's time is its middle. With `revolution_s` of 0 all rays
        leave at once."""
        beams = require_vector(beam_elevations, None, "beam_elevations")
        if not len(beams) or np.abs(beams).max() > np.pi / 2:
            raise RequestError("beam_elevations are at least one angle in radians, within 1.57 of the horizontal plane")
        if azimuth_steps != azimuth_steps // 1 or azimuth_steps < 1 or len(beams) * azimuth_steps > MAX_RAYS:
            raise RequestError(
                f"{len(beams)} beams with {azimuth_steps} azimuth_steps: a scan has 1 to {MAX_RAYS} rays"
            )
        if not 0.0 <= revolution_s < 10.0:
            raise RequestError(f"revolution_s is {revolution_s:g}; a revolution takes about 0.1 s")
        fractions = (np.arange(int(azimuth_steps)) + 0.5) / azimuth_steps
        azimuths = wrapped(np.pi + 2.0 * np.pi * fractions * (-1.0 if clockwise else 1.0))
        grids = np.broadcast_arrays(azimuths, beams[:, None], revolution_s * (fractions - 0.5))
        rays = ScanRays(*(np.ascontiguousarray(grid, dtype=np.float32) for grid in grids))
        return cls(rays, sensor_to_ego, None, beam_spread)

    def placed(self, sensor: SensorPoses, time: float) -> RecordedScan:
        """A scan at a time in seconds since the first image, of which nothing is recorded. `sensor` gives the poses (n,
        4, 4) of the sensor in the world at offsets (n,) in seconds from that time."""
        nothing = np.zeros(self.rays.shape, dtype=bool)
        ranges = np.zeros(self.rays.shape, dtype=np.float32)
        blocked = nothing if self.blocked is None else self.blocked
        scan = RecordedScan(
            lidar="", timestamp=0, seconds=time, sample_index=0, is_key_frame=False, group="excluded",
            sensor_to_world=np.eye(4), linear=np.zeros(3), angular=np.zeros(3), scan=Scan(self.rays, nothing, ranges),
            measured=~blocked, objects=np.full(self.rays.shape, NO_OBJECT, dtype=np.int16), blocked=blocked,
        )  # fmt: skip
        return moved(scan, sensor)
