"""Class names of NCore's cuboids as `ObjectClass`. Clips keep the names of the dataset that they were made from."""

import re

from drivesplat.scene.object_class import ObjectClass

_NAMES = {
    ObjectClass.CAR: "automobile passenger_car regular_vehicle sedan suv van pickup taxi",
    ObjectClass.TRUCK: "heavy_truck large_truck box_truck truck_cab pickup_truck semi_truck",
    ObjectClass.BUS: "trolley_bus school_bus articulated_bus bus_bendy bus_rigid coach",
    ObjectClass.TRAILER: "vehicular_trailer traffic_control_trailer message_board_trailer",
    ObjectClass.CONSTRUCTION_VEHICLE: "construction",
    ObjectClass.TRAM: "train train_or_tram_car railed_vehicle",
    ObjectClass.VEHICLE: (
        "other_vehicle large_vehicle emergency_vehicle ambulance police police_car fire_truck misc_vehicle "
        "emergency_ambulance emergency_police unknown_vehicle vehicle_other"
    ),
    ObjectClass.MOTORCYCLE: "motorbike",
    ObjectClass.BICYCLE: "bike wheeled_device",
    ObjectClass.RIDER: (
        "cyclist bicyclist motorcyclist wheeled_rider bicycle_rider motorcycle_rider person_on_rideables"
    ),
    ObjectClass.PEDESTRIAN: (
        "person human walker adult child person_sitting official_signaler construction_worker police_officer "
        "personal_mobility"
    ),
    ObjectClass.ANIMAL: "dog",
    ObjectClass.OTHER_MOVABLE: (
        "protruding_object stroller wheelchair sign unknown misc dontcare bollard construction_cone "
        "construction_barrel traffic_cone trafficcone barrier stop_sign mobile_pedestrian_crossing_sign "
        "pushable_pullable debris bicycle_rack traffic_light_trailer"
    ),
}
"""Other names of classes: those of Physical AI AV, Waymo, Argoverse 2, KITTI and nuScenes."""
_CLASSES = {kind.value: kind for kind in ObjectClass}
_CLASSES |= {name: kind for kind, names in _NAMES.items() for name in names.split()}
_GROUPS = ("vehicle", "human_pedestrian", "human", "movable_object", "static_object", "type", "label")
"""What names begin with in datasets whose names have parts, such as vehicle.bus.rigid and TYPE_VEHICLE."""


def object_class(label: str) -> ObjectClass | None:
    """The class of a label, in upper or lower case and with any signs between its words; None if it is unknown."""
    name = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
    for group in _GROUPS:
        found = _CLASSES.get(name)
        if found is not None:
            return found
        name = name.removeprefix(f"{group}_")
    return _CLASSES.get(name)
