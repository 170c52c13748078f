"""Settings of the rule `scans`."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.extract import OnMissing
from drivesplat.settings.images import HoldoutSettings


class SpinSettings(Settings):
    """How a LiDAR goes round."""

    revolution_s: float = Field(gt=0, le=10)
    """Seconds of a revolution."""
    start_azimuth_deg: float = Field(ge=-360, le=360)
    """Azimuth at which it begins (degrees from the sensor's x axis to its y axis)."""
    clockwise: bool = True
    """Direction, seen from above."""
    timestamp: float = Field(1.0, ge=0, le=1)
    """Fraction of the revolution that lies before the sweep's timestamp. 1 = the timestamp is its end."""


class ScanSettings(Settings):
    """LiDAR scans as rays, with and without a return. docs/lidar.md"""

    sweeps: bool = False
    """:printed: Use LiDAR sweeps between key frames, too. Needs lidar_seed.sweeps: true."""
    azimuth_steps: int | None = Field(None, ge=8, le=100_000)
    """Firings of a beam in one revolution. null = as the dataset states, or as the gaps between returns suggest. Has no
    effect where files hold all rays (Waymo)."""
    spin: SpinSettings | Literal["dataset"] | None = "dataset"
    """Times of returns that have none of their own: {revolution_s, start_azimuth_deg, clockwise: true, timestamp: 1},
    where `timestamp` is the fraction of the revolution before the sweep's timestamp. dataset = as the dataset states.
    null = all rays leave at the timestamp."""


class ScansJob(Settings):
    """All settings that determine the scans of one scene."""

    scans: ScanSettings
    holdout: HoldoutSettings
    own_car_radius: float
    on_missing: OnMissing
    """Action for a sweep that is missing, corrupt or gives no scan."""
