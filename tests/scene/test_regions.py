"""Boxes in images: polygons, hulls and labels compared with independently computed geometry."""

import dataclasses

import numpy as np
import pytest
from helpers.classed import classed
from helpers.drives import CAMERA_AT, Thing, World, drive, shows, true_depths
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.regions import LABELS, REGIONS, fill, hull_of, label_image, region_mask, visibility_source
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.scene.tracks import Box

SIZE = (384, 216)
"""Four times the size of the tiny drive's images."""
K = np.array([[200.0, 0.0, 160.0], [0.0, 210.0, 90.0], [0.0, 0.0, 1.0]])
"""A camera of 320 x 180 pixels, continuous convention."""


def inside_by_crossing_number(polygon: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Point in polygon by the crossing number (Shimrat 1962), pixel by pixel."""
    inside = np.zeros((size[1], size[0]), dtype=bool)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, 1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return inside


@given(st.integers(0, 2**32), st.sampled_from([((24, 16), 10), ((0, 0), 15), ((48, 30), 20), ((24, 16), 200)]))
def test_fill_selects_the_pixels_with_centres_in_the_polygon(seed, place):
    points = np.random.default_rng(seed).normal(*place, (8, 2))
    polygon = points[ConvexHull(points).vertices]
    for outline in (polygon, polygon[::-1]):
        np.testing.assert_array_equal(fill(outline, (48, 32)), inside_by_crossing_number(polygon, (48, 32)))


def box(position, size=(4.0, 2.0, 1.5), angle=0.0, category="vehicle.car") -> Box:
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return Box("it", *classed(category), np.array(size), rigid(turn, np.array(position, dtype=float)), 0.0, 4)


def surface(it: Box, steps: int = 41) -> np.ndarray:
    """Points all over the box's surface, edges and corners included, in world coordinates."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.5, 0.5, steps), np.linspace(-0.5, 0.5, steps)))
    sides = [
        np.roll(np.stack([np.full_like(u, s), u, v], axis=1), axis, axis=1) for s in (-0.5, 0.5) for axis in range(3)
    ]
    return np.concatenate(sides) * it.size @ it.object_to_world[:3, :3].T + it.object_to_world[:3, 3]


def seen(points: np.ndarray) -> np.ndarray:
    """Pixels of the points (n, 3) in front of the near plane of a camera at the origin that looks along z."""
    x, y, z = points[points[:, 2] >= 0.1].T
    return np.stack([200.0 * x / z + 160.0, 210.0 * y / z + 90.0], axis=1)


def area(polygon: np.ndarray) -> float:
    x, y = polygon.astype(float).T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2


@pytest.mark.parametrize(
    ("position", "angle"), [((0, 0, 10), 0.0), ((3, 1, 8), 0.4), ((-5, -2, 40), 1.2), ((20, 0, 12), 2.9)]
)
def test_the_hull_of_a_box_in_front_equals_that_of_its_corners(position, angle):
    hull = hull_of(box(position, angle=angle), np.eye(4), K)
    pixels = seen(surface(box(position, angle=angle)))
    expected = ConvexHull(pixels)
    assert area(hull) == pytest.approx(expected.volume, rel=1e-4)
    np.testing.assert_allclose(
        [hull.min(axis=0), hull.max(axis=0)], [pixels.min(axis=0), pixels.max(axis=0)], atol=0.01
    )


@pytest.mark.parametrize(
    ("position", "angle"), [((0.0, 0.3, 1.0), 0.0), ((1.2, 0.0, 0.5), 0.5), ((-1.0, 0.8, -0.4), 0.5)]
)
def test_a_box_that_straddles_the_camera_plane_is_clipped_at_the_near_plane(position, angle):
    size = (1.6, 1.0, 3.0)
    it = box(position, size, angle)
    hull = hull_of(it, np.eye(4), K)
    z = surface(it)[:, 2]
    assert z.min() < 0.1 < z.max(), "the case must straddle the near plane"
    visible = seen(surface(it, steps=301))
    mask = fill(hull, (320, 180))
    outside = inside_by_crossing_number(visible[ConvexHull(visible).vertices], (320, 180))
    assert mask.any()
    assert not (outside & ~mask).any(), "everything in front of the near plane is inside"
    assert (mask & ~outside).sum() <= 0.02 * mask.sum() + 4


@pytest.mark.parametrize("z", [-3.0, -0.7])
def test_a_box_behind_the_near_plane_has_no_hull(z):
    assert hull_of(box((0.0, 0.0, z), (1.0, 1.0, 1.5)), np.eye(4), K) is None


LARGER = World(width=SIZE[0], height=SIZE[1])


def visible(frame: Frame, category: str) -> np.ndarray:
    """The pixels (h, w) of a frame of SIZE in which the thing of this class is seen."""
    others = [thing for thing in LARGER.things if thing.category != category]
    without = true_depths(dataclasses.replace(LARGER, things=others), frame)
    return (true_depths(LARGER, frame) < without)[..., 0]


def alone(frame: Frame, category: str) -> np.ndarray:
    """The same, whatever is before it."""
    (thing,) = (thing for thing in LARGER.things if thing.category == category)
    return shows(LARGER, frame, thing)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize(
    ("category", "label"),
    [
        ("vehicle.car", "moving_car"),
        ("vehicle.truck", "parked_other_vehicle"),
        ("human.pedestrian.adult", "moving_human"),
    ],
)
@pytest.mark.parametrize("index", [1, 4])
def test_labels_of_the_tiny_drive_match_its_visible_objects(tiny_scene, category, label, index):
    frame = tiny_scene.frames[index]
    seen_alone = alone(frame, category)
    labels = label_image(tiny_scene, frame, SIZE)
    marked = labels == LABELS[label]
    nearer_thing = (labels != LABELS["static"]) & ~marked
    assert seen_alone.sum() > 200
    assert (marked | nearer_thing)[visible(frame, category)].mean() > 0.98
    assert iou(marked, seen_alone & ~nearer_thing) > 0.6


def test_an_object_between_key_frames_is_labelled_at_its_interpolated_position(tiny_scene):
    """Not at its position at the nearest key frame, 215 ms earlier."""
    frame = next(f for f in tiny_scene.frames if not f.is_key_frame)
    marked = label_image(tiny_scene, frame, SIZE) == LABELS["moving_car"]
    earlier = dataclasses.replace(frame, timestamp=frame.timestamp - 215_000)
    now, then = alone(frame, "vehicle.car"), alone(earlier, "vehicle.car")
    assert iou(marked, now) > iou(marked, then)


WALL = (1000, 400)
"""The size of an image whose camera has a focal length of 1000 pixels."""


def wall(
    name: str, columns: tuple[float, float], depth: float, level: int, kind: ObjectClass = ObjectClass.CAR
) -> Track:
    """A thin box that faces the camera `depth` metres away and covers these columns and rows 100 to 300 of WALL."""
    left, right = ((column - 500.0) / 1000.0 * depth for column in columns)
    size = np.array([right - left, 0.2 * depth, 0.002])
    pose = rigid(np.eye(3), np.array([(left + right) / 2, 0.0, depth + 0.001]))
    one = np.zeros(1, dtype=np.int64)
    return Track(name, kind, kind.value, size, one, one, pose[None], np.array([level]))


def labels_of_walls(*tracks: Track) -> np.ndarray:
    k = np.array([[1000.0, 0.0, 499.5], [0.0, 1000.0, 199.5], [0.0, 0.0, 1.0]])
    frame = Frame("front", 0, "", *WALL, k, np.eye(4), np.eye(4), True, 0, "")
    scene = Scene("it", "", "", "", np.zeros(3), np.zeros(1, dtype=np.int64), (frame,), (), tracks, "drive", 2.0)
    return label_image(scene, frame, WALL)


@pytest.mark.parametrize(("hidden", "expected"), [(0.59, "parked_car"), (0.60, "parked_car"), (0.61, "left_out")])
@pytest.mark.parametrize("by", [ObjectClass.CAR, ObjectClass.OTHER_MOVABLE])
def test_a_box_of_unknown_visibility_is_left_out_where_nearer_boxes_hide_more_than_60_percent(hidden, expected, by):
    """Of 200 columns; by two boxes that overlap, whose columns count once. A farther box hides nothing."""
    edge = 300.0 + 200.0 * hidden
    nearer = wall("a", (250.0, edge), 10.0, 4, by), wall("b", (280.0, edge - 30.0), 12.0, 4, by)
    labels = labels_of_walls(wall("far", (300.0, 500.0), 20.0, 0), *nearer, wall("behind", (300.0, 500.0), 30.0, 4))
    assert labels[200, 450] == LABELS[expected]
    for level in (2, 4):
        labels = labels_of_walls(wall("far", (300.0, 500.0), 20.0, level), *nearer)
        assert labels[200, 450] == LABELS["parked_car"], "an annotated visibility is not estimated"


def test_one_box_without_annotated_visibility_makes_it_estimated():
    known, cone = wall("a", (0, 9), 9.0, 4), wall("b", (0, 9), 9.0, 0, ObjectClass.OTHER_MOVABLE)
    for tracks, expected in (
        ([known, wall("b", (0, 9), 9.0, 1)], "annotated"), ([known, wall("b", (0, 9), 9.0, 0)], "estimated"),
        ([known, cone], "annotated"), ([], None),
    ):  # fmt: skip
        assert visibility_source(tracks) == expected


def test_boxes_under_100_pixels_are_left_out(tmp_path):
    things = [Thing("vehicle.car", (4.0, 2.0, 1.6), (12.0, 0.0, 0.8))]
    scene = drive(tmp_path, *things, key_frames=2, sweeps_between=0)
    seen_as = {}
    for width in range(32, 97, 4):
        labels = label_image(scene, scene.frames[0], (width, width * 9 // 16))
        (label,) = set(labels[labels != LABELS["static"]].tolist())
        seen_as[int((labels > 0).sum())] = label
    assert min(seen_as) < 100 <= max(seen_as)
    assert seen_as == {pixels: LABELS["left_out" if pixels < 100 else "parked_car"] for pixels in seen_as}


def test_the_nearer_box_wins_whatever_the_order_of_tracks(tmp_path):
    near = Thing("vehicle.car", (4.0, 2.0, 1.6), (10.0, 0.0, 0.8))
    far = Thing("vehicle.truck", (6.0, 6.0, 4.0), (25.0, 0.0, 2.0))
    scene = drive(tmp_path, near, far, key_frames=2, sweeps_between=0)
    car, truck = (
        label_image(dataclasses.replace(scene, tracks=only(scene, name)), scene.frames[0], SIZE) > 0
        for name in ("vehicle.car", "vehicle.truck")
    )
    assert (truck & car).any() and (truck & ~car).any(), "the boxes must overlap in the image"
    for tracks in (scene.tracks, scene.tracks[::-1]):
        labels = label_image(dataclasses.replace(scene, tracks=tracks), scene.frames[0], SIZE)
        np.testing.assert_array_equal(labels == LABELS["parked_car"], car)
        np.testing.assert_array_equal(labels == LABELS["parked_other_vehicle"], truck & ~car)


def only(scene: Scene, category: str) -> tuple[Track, ...]:
    return tuple(track for track in scene.tracks if track.category == category)


def ahead(category: str = "vehicle.car", velocity: float = 0.0, visibility: str = "4", at: float = 12.0) -> Thing:
    return Thing(category, (2.0, 2.0, 1.6), (at, 0.0, 0.8), velocity=(velocity, 0.0), visibility=visibility)


FAR = 1.7 - 0.035 * World().speed + 80.0
"""80 m before the camera: 1.7 m before the ego origin, minus the path driven in 35 ms."""
LARGE = Thing("vehicle.truck", (8.0, 3.0, 4.0), (0.0, 0.0, CAMERA_AT[2]))


@pytest.mark.parametrize(
    ("things", "expected"),
    [
        ([ahead(velocity=0.9)], "parked_car"),
        ([ahead(velocity=1.1)], "moving_car"),
        ([ahead("vehicle.bus.rigid")], "parked_other_vehicle"),
        ([ahead("vehicle.bicycle", 3.0)], "moving_other_vehicle"),
        ([ahead("human.pedestrian.child", 0.2)], "still_human"),
        ([ahead("human.pedestrian.child", 0.4)], "moving_human"),
        ([ahead("animal", 2.0)], "other"),
        ([ahead("movable_object.trafficcone", 3.0)], "static"),
        ([ahead(visibility="1")], "left_out"),
        ([ahead(visibility="2")], "parked_car"),
        ([ahead(visibility="1", at=10.0), ahead(at=20.0)], "left_out"),  # it hides the one behind it
        ([dataclasses.replace(LARGE, position=(FAR - 0.5, 0.0, CAMERA_AT[2]))], "parked_other_vehicle"),
        ([dataclasses.replace(LARGE, position=(FAR + 0.5, 0.0, CAMERA_AT[2]))], "left_out"),
    ],
)
def test_a_box_is_labelled_by_class_speed_visibility_and_distance(tmp_path, things, expected):
    scene = drive(tmp_path, *things, key_frames=2, sweeps_between=0)
    labels = label_image(scene, scene.frames[0], SIZE)
    assert {name for name, value in LABELS.items() if (labels == value).any()} == {"static", expected}


def test_regions_partition_the_image_as_in_the_protocol():
    labels = np.arange(256, dtype=np.uint8).reshape(16, 16) % len(LABELS)
    masks = {region: region_mask(labels, region) for region in REGIONS}
    assert set(masks) == {"all", "static", "vehicle", "car", "moving_vehicle", "parked_vehicle", "moving_human"}
    apart = (("static", "vehicle"), ("static", "moving_human"), ("vehicle", "moving_human"))
    for one, other in (*apart, ("moving_vehicle", "parked_vehicle")):
        assert not (masks[one] & masks[other]).any()
    np.testing.assert_array_equal(masks["moving_vehicle"] | masks["parked_vehicle"], masks["vehicle"])
    assert (masks["car"] <= masks["vehicle"]).all() and (masks["car"] != masks["vehicle"]).any()
    left_out = labels == LABELS["left_out"]
    assert masks["all"][left_out].all()
    assert not any(mask[left_out].any() for region, mask in masks.items() if region != "all")
    assert not any(mask[labels == LABELS["own_car"]].any() for mask in masks.values())
    assert masks["all"][labels != LABELS["own_car"]].all()
