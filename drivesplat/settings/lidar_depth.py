"""Settings of the rule `lidar_depth`."""

from typing import Annotated

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings, ImageSettings

Degrees = Annotated[float, Field(ge=0, le=10)]


class LidarDepthSettings(Settings):
    """LiDAR depth in images, for supervision (`train.depth_weight`) and for evaluation."""

    ray_spacing: tuple[Degrees, Degrees] = (0.33, 1.33)
    """Angle between neighbouring LiDAR rays (degrees), in azimuth and elevation. nuScenes: 0.33 and 1.33. A return
    occludes returns that are clearly behind it within one ray spacing, since the LiDAR sees over objects that hide the
    background from the camera. [0, 0] = a return occludes its own four pixels only."""


class LidarDepthJob(Settings):
    """All settings that determine the LiDAR depth in the images of one scene."""

    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    ray_spacing: tuple[Degrees, Degrees]
    box_margin: float
    """Returns within this distance (metres) of the box of a moving object are dynamic."""
