"""What the stage `actors` may be told."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class ActorSeedSettings(Settings):
    """What becomes an actor, a set of Gaussians of its own, and where its Gaussians start. An actor is a vehicle that
    moves in the drive and that a training image sees."""

    cycles: bool = True
    """Whether bicycles and motorcycles become actors, too."""
    humans: bool = False
    """Whether people do: as rigid as their boxes."""
    min_points: int = Field(2_000, ge=0)
    """With fewer LiDAR points than this over the whole drive an actor gets random points in its box as well."""
    random_points: int = Field(8_000, ge=0, le=1_000_000)
    """Then it has so many points, LiDAR's included."""
    max_points: int = Field(20_000, ge=1, le=10_000_000)
    """Most points of an actor; beyond it they are thinned at random."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """LiDAR returns that are nearer than this (metres) to the box's sides or roof are the actor's, too."""


class ActorSeedJob(Settings):
    """Everything that decides the content of one actors.pkl, the scene aside."""

    actors: ActorSeedSettings
    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    random_seed: int
