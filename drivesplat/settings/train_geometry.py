"""Settings of what is known of the geometry of a scene beside its images: empty space and the road."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings


class FloaterSettings(Settings):
    radius: float = Field(1.0, ge=0, le=10)
    """Distance from the path of the training cameras (metres) within which Gaussians are faded out: the ego vehicle
    drove there, so the space is empty. 0 = off."""
    below_road: bool = False
    """Also fade out Gaussians whose centres lie `train.road.reach` to 5 m below the road. Needs `train.road_weight`
    above 0. Leave this off on wet roads, which mirror what is above them."""
    every: int = Field(100, ge=1)
    """Iterations between these steps."""


class RoadSettings(Settings):
    """The surface of the road: for the part `road`, whose Gaussians lie in it, and without this part for the background
    Gaussians that train.road_weight acts on (docs/geometry.md)."""

    surface: Literal["path", "lidar", "lidar_or_path"] = "path"
    """'path': the road under the path of the vehicle, which follows from its poses. 'lidar': the ground wherever LiDAR
    seed points show it. 'lidar_or_path': the latter, and where LiDAR gives no plane of the ground, the former."""
    half_width: float = Field(1.2, gt=0, le=10)
    """Maximum lateral distance from the path of the vehicle's centre (metres) of the road under the path. The weight
    falls with this distance, since kerbs and grass may begin beside the vehicle."""
    reach: float = Field(0.3, gt=0, le=2)
    """Maximum height of a centre above or below the road surface (metres). The part `road` has a layer of its own."""
