"""Settings of the rule `actors`."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class ActorSeedSettings(Settings):
    """Selection of actors and of their seed points. An actor is a vehicle that moves during the drive and is visible in
    a training image; it gets a set of Gaussians in its own frame."""

    cycles: bool = True
    """Make actors of bicycles and motorcycles, too."""
    humans: bool = False
    """Make actors of people, too. They are as rigid as their boxes."""
    min_points: int = Field(2_000, ge=0)
    """Minimum number of LiDAR points of an actor over the whole drive. With fewer, random points in its box are added.
    """
    random_points: int = Field(8_000, ge=0, le=1_000_000)
    """Number of points, LiDAR points included, up to which random points are added."""
    max_points: int = Field(20_000, ge=1, le=10_000_000)
    """Maximum number of seed points of an actor. Further points are dropped at random."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """LiDAR returns closer than this (metres) to the sides or the roof of a box belong to its actor."""


class ActorSeedJob(Settings):
    """All settings that determine the actors' seed of one scene."""

    actors: ActorSeedSettings
    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    random_seed: int
