"""What the stage `own_car` may be told."""

from typing import Literal

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings

OwnCarKind = Literal["none", "polygons", "auto", "auto_measured"]


class OwnCarSearch(Settings):
    """How the own car's body is looked for in the images of `cameras`."""

    cameras: tuple[str, ...]
    holdout: HoldoutSettings
    own_car_radius: float
    """LiDAR returns nearer to the sensor than this (metres, horizontally) are the own car's."""


class OwnCarJob(Settings):
    """Everything that decides the content of one own_car.json, the scene aside."""

    polygons: dict[str, tuple[tuple[float, float], ...]]
    search: OwnCarSearch | None
    """None: nothing is looked for."""
