"""The properties of object classes in the measuring protocol."""

import dataclasses

import numpy as np

from drivesplat.readers.nuscenes.object_classes import object_class
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.regions import label_image, region_mask

NUSCENES = {
    "animal": "animal", "human.pedestrian.adult": "pedestrian", "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian", "human.pedestrian.personal_mobility": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian", "human.pedestrian.stroller": "pedestrian",
    "human.pedestrian.wheelchair": "pedestrian", "movable_object.barrier": "other_movable",
    "movable_object.debris": "other_movable", "movable_object.pushable_pullable": "other_movable",
    "movable_object.trafficcone": "other_movable", "static_object.bicycle_rack": "other_movable",
    "vehicle.bicycle": "bicycle", "vehicle.bus.bendy": "bus", "vehicle.bus.rigid": "bus", "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle", "vehicle.emergency.ambulance": "vehicle",
    "vehicle.emergency.police": "vehicle", "vehicle.motorcycle": "motorcycle", "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}  # fmt: skip
"""All 23 classes of nuScenes."""
OTHERS = {
    "car": "car", "pedestrian": "pedestrian", "other_vehicle": "vehicle", "bus": "bus", "truck": "truck", "CAR": "car",
    "motorcycle": "motorcycle", "emergency_vehicle": "vehicle", "bicycle": "bicycle", "vehicle.ego.car": "vehicle",
    "traffic_cone": "other_movable",
}  # fmt: skip
"""Classes of other tables in its layout."""


def test_every_class_of_nuscenes_has_an_object_class_with_the_properties_of_its_prefix():
    for category, expected in NUSCENES.items():
        kind, known = category.split(".")[0], object_class(category)
        assert known.value == expected
        assert (known.is_vehicle, known.is_human) == (kind == "vehicle", kind == "human"), category
        assert known.is_dynamic == (kind in ("vehicle", "human", "animal")), category
    assert {name: object_class(name).value for name in OTHERS} == OTHERS


def test_vehicles_move_above_1_metre_per_second_pedestrians_above_0_3_others_never():
    for known in ObjectClass:
        threshold = 0.3 if known.value == "pedestrian" else 1.0
        assert not known.moves_at(threshold)
        assert known.moves_at(threshold + 0.01) == (known.value not in ("animal", "other_movable"))


def test_without_a_class_for_cars_no_pixel_belongs_to_a_car(tiny_scene):
    tracks = (
        dataclasses.replace(track, object_class=ObjectClass.VEHICLE) if track.object_class.is_vehicle else track
        for track in tiny_scene.tracks
    )
    frame = tiny_scene.frames[6]
    with_cars, without_cars = (
        label_image(scene, frame, (frame.width, frame.height))
        for scene in (tiny_scene, dataclasses.replace(tiny_scene, tracks=tuple(tracks)))
    )
    assert region_mask(with_cars, "car").sum() > 100 and not region_mask(without_cars, "car").any()
    for region in ("vehicle", "moving_vehicle", "parked_vehicle", "static"):
        np.testing.assert_array_equal(region_mask(with_cars, region), region_mask(without_cars, region))
