"""What the stage `lidar_depth` may be told."""

from typing import Annotated

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings

Degrees = Annotated[float, Field(ge=0, le=10)]


class LidarDepthSettings(Settings):
    """LiDAR's depth in images, which trainings are held to (`train.depth_weight`) and renderings measured by."""

    ray_spacing: tuple[Degrees, Degrees] = (0.33, 1.33)
    """Degrees between neighbouring rays, in azimuth and elevation (nuScenes': 0.33 and 1.33). A return hides what lies
    clearly behind it in the window of the image between its rays: LiDAR looks over what is before the camera. [0, 0] =
    only in its own four pixels."""


class LidarDepthJob(Settings):
    """Everything that decides what LiDAR's depth in the images of a scene is: the content of lidar_depth.pkl."""

    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    ray_spacing: tuple[Degrees, Degrees]
    box_margin: float
    """Returns nearer than this (metres) to the box of something that moves do not stand still."""
