"""What the stage `lidar_depth` may be told."""

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class LidarDepthJob(Settings):
    """Everything that decides the content of one lidar_depth.pkl, the scene aside."""

    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    box_margin: float
    """Returns nearer than this (metres) to the box of something that moves do not stand still."""
