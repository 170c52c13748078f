"""The properties of object classes in the measuring protocol."""

import dataclasses

import numpy as np
import pytest

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


@pytest.mark.parametrize(("category", "expected"), NUSCENES.items())
def test_every_class_of_nuscenes_has_an_object_class(category, expected):
    assert object_class(category).value == expected


@pytest.mark.parametrize("category", NUSCENES)
def test_vehicles_humans_and_dynamic_objects_agree_with_the_prefix_of_their_nuscenes_class(category):
    kind, known = category.split(".")[0], object_class(category)
    assert known.is_vehicle == (kind == "vehicle")
    assert known.is_human == (kind == "human")
    assert known.is_dynamic == (kind in ("vehicle", "human", "animal"))


@pytest.mark.parametrize("known", ObjectClass)
def test_vehicles_move_above_1_metre_per_second_pedestrians_above_0_3_others_never(known):
    humans, never = {"pedestrian"}, {"animal", "other_movable"}
    threshold = 0.3 if known.value in humans else 1.0
    assert not known.moves_at(threshold)
    assert known.moves_at(threshold + 0.01) == (known.value not in never)


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
