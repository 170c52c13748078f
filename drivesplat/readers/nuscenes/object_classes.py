"""Class names of nuScenes, and of others' tables in its layout, as `ObjectClass`."""

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
"""Classes by name or by a prefix that ends before a dot. Ambulances and police cars are VEHICLE, names not listed
(cones, barriers, bicycle racks) OTHER_MOVABLE. Boxes of cycles include riders."""


_PLAIN = {
    **{kind.value: kind for kind in ObjectClass},
    **dict.fromkeys(
        ("other_vehicle", "emergency_vehicle", "ambulance", "police_car", "fire_truck"), ObjectClass.VEHICLE
    ),
    "motorbike": ObjectClass.MOTORCYCLE,
    "cyclist": ObjectClass.RIDER,
    "motorcyclist": ObjectClass.RIDER,
    "train": ObjectClass.TRAM,
}
"""Names without a dot, as in the tables of Lyft and TIER IV."""


def object_class(category: str) -> ObjectClass:
    """The class of a category name such as vehicle.bus.rigid."""
    while category not in _CLASSES and "." in category:
        category = category.rpartition(".")[0]
    return _CLASSES.get(category) or _PLAIN.get(category.lower(), ObjectClass.OTHER_MOVABLE)


_CATEGORIES = {
    ObjectClass.BUS: "vehicle.bus.rigid",
    ObjectClass.VEHICLE: "vehicle.other",
    ObjectClass.TRAM: "vehicle.tram",
    ObjectClass.RIDER: "vehicle.bicycle",
    ObjectClass.PEDESTRIAN: "human.pedestrian.adult",
    ObjectClass.OTHER_MOVABLE: "movable_object.other",
}
"""Categories of classes that have no name of their own above; nuScenes has none of trams and of unknown vehicles."""


def category_of(kind: ObjectClass, name: str) -> str:
    """The category of an object in nuScenes' tables: `name` where it reads as one of that class."""
    if "." in name and object_class(name) is kind:
        return name
    return _CATEGORIES.get(kind) or next(category for category, known in _CLASSES.items() if known is kind)
