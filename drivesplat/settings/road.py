"""Settings of the road loss."""

from pydantic import Field

from drivesplat.settings import Settings


class RoadSettings(Settings):
    """Selection of the background Gaussians that train.road_weight acts on."""

    half_width: float = Field(1.2, gt=0, le=10)
    """Maximum lateral distance from the path of the vehicle's centre (metres). The weight falls with this distance,
    since kerbs and grass may begin beside the vehicle."""
    reach: float = Field(0.3, gt=0, le=2)
    """Maximum height of a centre above or below the road surface (metres)."""
