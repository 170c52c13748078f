"""nuScenes' class names as `ObjectClass`."""

from drivesplat.scene.object_class import ObjectClass

_CLASSES = {
    "vehicle.car": ObjectClass.CAR,
    "vehicle.truck": ObjectClass.TRUCK,
    "vehicle.bus": ObjectClass.BUS,
    "vehicle.trailer": ObjectClass.TRAILER,
    "vehicle.construction": ObjectClass.CONSTRUCTION_VEHICLE,
    "vehicle.motorcycle": ObjectClass.MOTORCYCLE,
    "vehicle.bicycle": ObjectClass.BICYCLE,
    "vehicle": ObjectClass.VEHICLE,
    "human": ObjectClass.PEDESTRIAN,
    "animal": ObjectClass.ANIMAL,
}
"""By a class's name or what comes before one of its dots; ambulances and police cars are vehicles of no type named
here, all else (cones, barriers, bicycle racks) is OTHER_MOVABLE. Boxes of cycles include riders."""


def object_class(category: str) -> ObjectClass:
    """The class of a category's name, such as vehicle.bus.rigid."""
    while category not in _CLASSES and "." in category:
        category = category.rpartition(".")[0]
    return _CLASSES.get(category, ObjectClass.OTHER_MOVABLE)
