"""Settings of the rule `actors`."""

from typing import get_args

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.object_classes import ObjectClassName
from drivesplat.settings.train import STAGE_OF_PART, PartName

CYCLES = ("motorcycle", "bicycle", "rider")
NO_VEHICLES = ("pedestrian", "animal", "other_movable")
ClassParts = PartName | tuple[PartName, ...]
DEFAULT_CLASSES: dict[ObjectClassName, ClassParts] = {
    name: "background" if name in NO_VEHICLES else "actors" for name in get_args(ObjectClassName)
}


class ActorSeedSettings(Settings):
    """Selection of actors and of their seed points. An actor is a vehicle that moves during the drive and is visible in
    a training image; it gets a set of Gaussians in its own frame."""

    classes: dict[ObjectClassName, ClassParts] = DEFAULT_CLASSES
    """:printed: The part of a model that represents the moving objects of each class, or several: the first that a
    method has."""
    cycles: bool = True
    """Make actors of motorcycles, bicycles and riders, too. false overrides `classes`."""
    humans: bool = False
    """:printed: Make actors of pedestrians, too, as rigid as their boxes. true overrides `classes`."""
    min_points: int = Field(2_000, ge=0)
    """Minimum number of LiDAR points of an actor over the whole drive. With fewer, random points in its box are added.
    """
    random_points: int = Field(8_000, ge=0, le=1_000_000)
    """Number of points, LiDAR points included, up to which random points are added in boxes with fewer than min_points.
    Boxes of other vehicles get this number times the share of their height above their LiDAR points, on the sides and
    the roof there."""
    max_points: int = Field(20_000, ge=1, le=10_000_000)
    """Maximum number of seed points of an actor. Further points are dropped at random."""
    box_margin: float = Field(0.1, ge=0, le=2)
    """LiDAR returns closer than this (metres) to the sides or the roof of a box belong to its actor."""
    smoothed: bool = True
    """Smooth annotated motions before anything is learned: boxes wander by centimetres from one annotation to the next,
    as no vehicle does (docs/street.md). Metrics keep the annotated boxes."""

    def parts_of(self, object_class: str) -> tuple[PartName, ...]:
        """The parts of moving objects that can represent a class, the best first; none for the background."""
        if object_class in CYCLES and not self.cycles:
            return ()
        if object_class == "pedestrian" and self.humans:
            return ("actors",)
        chosen = {**DEFAULT_CLASSES, **self.classes}[object_class]
        every = (chosen,) if isinstance(chosen, str) else chosen
        before_background = every[: every.index("background")] if "background" in every else every
        return tuple(part for part in before_background if part in STAGE_OF_PART)


class ActorSeedJob(Settings):
    """All settings that determine the actors' seed of one scene."""

    actors: ActorSeedSettings
    holdout: HoldoutSettings
    images: ImageSettings
    own_car_radius: float
    random_seed: int
