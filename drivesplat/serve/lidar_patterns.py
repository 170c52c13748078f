"""The patterns of LiDARs that requests name, from the public data sheets of Hesai.

Both are approximations: the elevations are those of the data sheets' resolutions, not of a sensor's calibration; all
beams fire together, at evenly spaced azimuths; ranges are not limited; and the spread of a beam is that with which the
model was trained.
"""

from collections.abc import Callable

import numpy as np

from drivesplat.drive.lidars import PoseableLidar
from drivesplat.scene.scan import ScanRays
from drivesplat.serve.messages import wire

PANDAR128_CHANNELS = (1, 26, 90, 128)
PANDAR128_ELEVATIONS = (14.4, 2.0, -6.0, -25.0)
"""Degrees above the horizontal plane of these channels: 0.125 degrees apart around the horizon, 0.5 elsewhere."""
PANDAR128_STEPS = 3600
"""Firings in a revolution, 0.1 degrees apart."""
AT128_CHANNELS, AT128_STEPS = 128, 1200
AT128_VERTICAL, AT128_HORIZONTAL = (12.5, -12.9), 120.0
"""Fields of view in degrees: from the highest beam to the lowest, 0.2 apart, and to both sides together, 0.1 apart."""


def pandar128(seconds: float) -> PoseableLidar:
    """Hesai Pandar128: 128 beams from 14.4 to -25 degrees, once round clockwise from behind in `seconds`."""
    elevations = np.interp(np.arange(1, 129), PANDAR128_CHANNELS, PANDAR128_ELEVATIONS)
    return PoseableLidar.spinning(np.radians(elevations), PANDAR128_STEPS, seconds)


def at128(seconds: float) -> PoseableLidar:
    """Hesai AT128: 128 beams from 12.5 to -12.9 degrees sweep the 120 degrees ahead from left to right in `seconds`."""
    fractions = (np.arange(AT128_STEPS) + 0.5) / AT128_STEPS
    elevations = np.linspace(*np.radians(AT128_VERTICAL), AT128_CHANNELS)[:, None]
    azimuths = np.radians(AT128_HORIZONTAL) * (0.5 - fractions)
    grids = np.broadcast_arrays(azimuths, elevations, seconds * (fractions - 0.5))
    return PoseableLidar(ScanRays(*(np.ascontiguousarray(grid, dtype=np.float32) for grid in grids)))


PATTERNS: dict[int, Callable[[float], PoseableLidar]] = {
    wire.LidarDeviceType.PANDAR128: pandar128,
    wire.LidarDeviceType.AT128: at128,
}
"""The LiDARs of `wire.LidarDeviceType`, for a spin of so many seconds."""
