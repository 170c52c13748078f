"""The road that was driven on, for trainings that are held to it."""

from pydantic import Field

from drivesplat.settings import Settings


class RoadSettings(Settings):
    """Where background Gaussians are the road's, for train.road_weight."""

    half_width: float = Field(1.2, gt=0, le=10)
    """Within so many metres to either side of the car's middle, and the less the farther out: a car is 1.7 to 1.9
    metres wide, and beside it are kerbs and grass."""
    reach: float = Field(0.3, gt=0, le=2)
    """Centres within so many metres above or below the road's surface."""
