"""The classes of annotated objects, and their properties in the measuring protocol.

A reader maps its dataset's class names to these. A dataset with one class for all vehicles maps it to VEHICLE; then no
pixel belongs to the region `car`, and its metrics are null.
"""

from enum import StrEnum

MOVING_VEHICLE = 1.0
"""Horizontal speed in m/s above which a vehicle counts as moving."""
MOVING_HUMAN = 0.3
"""Horizontal speed in m/s above which a person counts as moving."""


class ObjectClass(StrEnum):
    """The class of an object; the values appear in scene.json and in settings."""

    CAR = "car"
    TRUCK = "truck"
    BUS = "bus"
    TRAILER = "trailer"
    CONSTRUCTION_VEHICLE = "construction_vehicle"
    TRAM = "tram"
    VEHICLE = "vehicle"
    """A vehicle of unknown or other type."""
    MOTORCYCLE = "motorcycle"
    BICYCLE = "bicycle"
    RIDER = "rider"
    """A person and a cycle, annotated as one object."""
    PEDESTRIAN = "pedestrian"
    ANIMAL = "animal"
    OTHER_MOVABLE = "other_movable"
    """Cones, barriers and similar objects, which the protocol treats as static."""

    @property
    def is_vehicle(self) -> bool:
        """Whether it belongs to the region `vehicle`, which includes cycles with and without a rider."""
        return not self.is_human and self not in (ObjectClass.ANIMAL, ObjectClass.OTHER_MOVABLE)

    @property
    def is_solid(self) -> bool:
        """Whether it fills most of its box: a vehicle that is neither a cycle nor a construction vehicle."""
        with_gaps = (ObjectClass.MOTORCYCLE, ObjectClass.BICYCLE, ObjectClass.RIDER, ObjectClass.CONSTRUCTION_VEHICLE)
        return self.is_vehicle and self not in with_gaps

    @property
    def is_human(self) -> bool:
        """Whether it is a person on foot."""
        return self is ObjectClass.PEDESTRIAN

    @property
    def is_dynamic(self) -> bool:
        """Whether its boxes are left out of the region `static`, moving or not."""
        return self is not ObjectClass.OTHER_MOVABLE

    def moves_at(self, speed: float) -> bool:
        """Whether it counts as moving at a horizontal `speed` in m/s; animals and other objects never do."""
        return (self.is_vehicle and speed > MOVING_VEHICLE) or (self.is_human and speed > MOVING_HUMAN)
