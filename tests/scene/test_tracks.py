"""Poses of objects between annotations by the measuring protocol's rules, compared with closed forms."""

import numpy as np
import pytest
from helpers.classed import classed
from helpers.drives import ORIGIN, START_US, World

from drivesplat.scene.rigid import interpolate, rigid
from drivesplat.scene.scene import Track
from drivesplat.scene.tracks import box_at, boxes_at, ever_moves

INTERVAL = 500_000.0
"""Microseconds between key frames."""
START = 1_532_402_927_647_951


def turned(angle: float) -> np.ndarray:
    """A rotation about z, in closed form."""
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def track(indices, positions, angles=None, category="vehicle.car", visibility=None) -> Track:
    """An object seen at key frames `indices`, half a second apart."""
    angles = np.zeros(len(indices)) if angles is None else angles
    return Track(
        "it", *classed(category), np.array([4.0, 2.0, 1.5]), START + np.array(indices) * 500_000, np.array(indices),
        np.stack([rigid(turned(a), np.array(p, dtype=float)) for a, p in zip(angles, positions, strict=True)]),
        np.array(visibility if visibility is not None else [4] * len(indices)),
    )  # fmt: skip


def at(seconds: float) -> int:
    return START + round(seconds * 1e6)


def assert_pose(pose: np.ndarray, angle: float, position) -> None:
    np.testing.assert_allclose(pose[:3, :3], turned(angle), atol=1e-9)
    np.testing.assert_allclose(pose[:3, 3], position, atol=1e-9)
    np.testing.assert_array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])


def test_interpolation_is_linear_in_position_and_in_the_angle_about_the_shortest_axis():
    start, end = rigid(turned(0.3), np.array([1.0, 2.0, 3.0])), rigid(turned(1.1), np.array([5.0, 0.0, 3.0]))
    for fraction in (-0.5, 0.0, 0.25, 1.0, 1.5):
        expected = [1.0 + 4.0 * fraction, 2.0 - 2.0 * fraction, 3.0]
        assert_pose(interpolate(start, end, fraction), 0.3 + 0.8 * fraction, expected)
    start, end = rigid(turned(3.0), np.zeros(3)), rigid(turned(-3.0), np.zeros(3))
    assert_pose(interpolate(start, end, 0.5), np.pi, np.zeros(3))


def test_interpolation_about_a_tilted_axis_is_rodrigues_rotation():
    axis, angle = np.array([1.0, 2.0, 2.0]) / 3.0, 1.2
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])

    def rodrigues(a):
        return np.eye(3) + np.sin(a) * k + (1.0 - np.cos(a)) * k @ k

    base = turned(0.7)
    start, end = rigid(base, np.zeros(3)), rigid(base @ rodrigues(angle), np.zeros(3))
    np.testing.assert_allclose(interpolate(start, end, 0.25)[:3, :3], base @ rodrigues(angle / 4), atol=1e-9)


def test_each_segment_interpolates_its_own_ends_and_has_its_horizontal_speed():
    it = track([0, 1, 2], [(0, 0, 0), (1.0, 0, 0), (1.0, 4.0, 7.0)])
    for seconds, place, speed in ((0.25, [0.5, 0.0, 0.0], 2.0), (0.75, [1.0, 2.0, 3.5], 8.0)):
        box = box_at(it, at(seconds), INTERVAL)
        np.testing.assert_allclose(box.object_to_world[:3, 3], place)
        assert box.speed == pytest.approx(speed)
    for seconds in (-0.25, 0.0, 0.75):
        one = track([0, 1], [(0, 0, 0), (1.5, 2.0, 7.0)])
        assert box_at(one, at(seconds), INTERVAL).speed == pytest.approx(5.0)


@pytest.mark.parametrize("beyond", [0.001, 0.25])
def test_up_to_half_an_interval_beyond_an_end_the_end_segments_motion_continues(beyond):
    it = track([3, 4, 5], [(0, 0, 0), (1.0, 0, 0), (1.0, 2.0, 0)], [0.0, 0.1, 0.5])
    after = box_at(it, at(2.5 + beyond), INTERVAL)
    assert_pose(after.object_to_world, 0.5 + 0.8 * beyond, [1.0, 2.0 + 4.0 * beyond, 0.0])
    before = box_at(it, at(1.5 - beyond), INTERVAL)
    assert_pose(before.object_to_world, -0.2 * beyond, [-2.0 * beyond, 0.0, 0.0])


@pytest.mark.parametrize("beyond", [0.2501, 10.0])
def test_the_object_is_absent_more_than_half_an_interval_beyond_an_end(beyond):
    for it in (track([3, 4, 5], [(0, 0, 0), (1.0, 0, 0), (1.0, 2.0, 0)]), track([5], [(0, 0, 0)])):
        assert box_at(it, at(2.5 + beyond), INTERVAL) is None
        assert box_at(it, at((len(it.timestamps) == 1) + 1.5 - beyond), INTERVAL) is None


@pytest.mark.parametrize("offset", [-0.25, 0.0, 0.25])
def test_a_single_box_is_static(offset):
    box = box_at(track([2], [(5.0, 6.0, 7.0)], [0.4]), at(1.0 + offset), INTERVAL)
    assert_pose(box.object_to_world, 0.4, [5.0, 6.0, 7.0])
    assert box.speed == 0.0 and not box.moves


GAP = ([0, 1, 3, 4], [(0, 0, 0), (1.0, 0, 0), (30.0, 0, 0), (34.0, 0, 0)])
"""The object is not annotated at key frame 2."""


def test_the_motion_continues_into_a_gap_and_a_new_run_begins_after_it():
    places = {0.5: 1.0, 0.7: 1.4, 0.75: 1.5, 1.25: 28.0, 1.3: 28.4, 1.5: 30.0, 1.75: 32.0}
    for seconds, x in places.items():
        box = box_at(track(*GAP), at(seconds), INTERVAL)
        np.testing.assert_allclose(box.object_to_world[:3, 3], [x, 0, 0], atol=1e-9)
    assert all(box_at(track(*GAP), at(seconds), INTERVAL) is None for seconds in (0.76, 1.0, 1.24))


def test_a_box_moves_by_its_current_speed_and_a_track_by_any_of_its_boxes():
    starts = track([0, 1, 2], [(0, 0, 0), (0.1, 0, 0), (3.1, 0, 0)])
    assert not box_at(starts, at(0.25), INTERVAL).moves
    assert box_at(starts, at(0.75), INTERVAL).moves
    assert ever_moves(starts)
    assert not ever_moves(track([0, 1, 2], [(0, 0, 0), (0.1, 0, 0), (0.2, 0, 0)]))
    assert not ever_moves(track([0], [(0, 0, 0)]))
    assert not ever_moves(track([0, 1, 3, 4], [(0, 0, 0), (0, 0, 0), (30.0, 0, 0), (30.0, 0, 0)])), "a gap"


def test_the_boxes_of_the_tiny_drive_match_its_objects(tiny_scene):
    seconds = 1.1
    boxes = {box.category: box for box in boxes_at(tiny_scene, START_US + round(seconds * 1e6))}
    for thing in World().things:
        box = boxes[thing.category]
        np.testing.assert_allclose(
            box.object_to_world[:3, 3] + tiny_scene.origin, ORIGIN + thing.at(seconds), atol=1e-6
        )
        np.testing.assert_array_equal(box.size, thing.size)
        assert box.speed == pytest.approx(np.hypot(*thing.velocity), abs=1e-6)
