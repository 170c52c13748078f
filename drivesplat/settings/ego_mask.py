"""Settings of the rule `own_car`, which finds the ego vehicle's body in images."""

from typing import Literal

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings

EgoMaskKind = Literal["none", "polygons", "auto", "auto_measured"]


class EgoMaskSearch(Settings):
    """Search for the ego vehicle's body in the images of `cameras`."""

    cameras: tuple[str, ...]
    holdout: HoldoutSettings
    own_car_radius: float
    """Horizontal distance from the LiDAR (metres) within which returns belong to the ego vehicle."""


class EgoMaskJob(Settings):
    """All settings that determine the own_car.json of one scene."""

    polygons: dict[str, tuple[tuple[float, float], ...]]
    search: EgoMaskSearch | None
    """None: polygons only."""
