"""The ground along a drive, from the returns of all its scans that do not move.

Far ahead the beams of a LiDAR pass above and below the road. The vehicle comes there later, and sees it from near.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from drivesplat.lidar.ground import GroundMap
from drivesplat.scene.scan_record import RecordedScan

REACH = 40.0
"""Metres from the sensor within which returns count."""
MAX_SCANS = 100
"""Number of scans, evenly spaced, that are enough for a map."""


def ground_of(scans: Sequence[RecordedScan], moving: Sequence[Bool[np.ndarray, " _"]]) -> GroundMap:
    """The map of the ground by the measured returns of scans without those that are `moving`, an array for each
    scan."""
    chosen = np.unique(np.linspace(0, len(scans) - 1, MAX_SCANS).round().astype(int))
    return GroundMap(np.concatenate([_near(scans[k], moving[k]) for k in chosen]))


def _near(scan: RecordedScan, moving: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "m 3"]:
    points = scan.points()[~moving]
    return points[np.linalg.norm(points - scan.sensor_to_world[:3, 3], axis=1) < REACH]
