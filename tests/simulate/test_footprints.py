"""Overlap of oriented boxes and the time until they touch, compared with closed forms and with points in rectangles."""

import numpy as np
import pytest
from helpers.driven_runs import SHAPE, poses
from hypothesis import given
from hypothesis import strategies as st

from drivesplat.simulate.footprints import (
    OrientedBoxes,
    ego_boxes,
    other_boxes,
    overlapping,
    time_to_contact,
    upright_boxes,
)


def box(x: float, y: float, yaw: float, length: float, width: float, z: float = 0.0) -> OrientedBoxes:
    return upright_boxes(poses([x], y, yaw, z), np.array([length, width, 2.0]))


def inside(boxes: OrientedBoxes, points: np.ndarray, slack: float) -> np.ndarray:
    """Whether points (n, 2) are in the rectangle of one box, enlarged by `slack`."""
    local = points - boxes.centre[0, :2]
    along, across = local @ boxes.forward[0], local @ boxes.left[0]
    return (np.abs(along) <= boxes.half[0, 0] + slack) & (np.abs(across) <= boxes.half[0, 1] + slack)


def test_the_ego_vehicle_reaches_from_its_rear_overhang_to_its_front():
    corners = ego_boxes(poses([10.0], 5.0, np.pi / 2), SHAPE).corners[0]
    np.testing.assert_allclose(corners, [[9.05, 8.7], [10.95, 8.7], [10.95, 4.1], [9.05, 4.1]], atol=1e-12)


@pytest.mark.parametrize(
    ("other", "touches"),
    [
        ((4.99, 0.0, 0.0, 6.0, 2.0), True), ((5.01, 0.0, 0.0, 6.0, 2.0), False),
        ((0.0, 1.99, 0.0, 6.0, 2.0), True), ((0.0, 2.01, 0.0, 6.0, 2.0), False),
        ((0.0, 3.99, np.pi / 2, 6.0, 2.0), True), ((0.0, 4.01, np.pi / 2, 6.0, 2.0), False),
        # a turned square whose side faces this corner: only its own sides separate the two
        ((2.0 + 0.99, 1.0 + 0.99, np.pi / 4, 2.82, 2.82), True),
        ((2.0 + 1.01, 1.0 + 1.01, np.pi / 4, 2.82, 2.82), False),
    ],
)  # fmt: skip
def test_rectangles_overlap_on_all_axes_or_not_at_all(other, touches):
    assert overlapping(box(0.0, 0.0, 0.0, 4.0, 2.0), box(*other)).tolist() == [touches]
    assert overlapping(box(*other), box(0.0, 0.0, 0.0, 4.0, 2.0)).tolist() == [touches]


def test_a_bridge_above_the_road_does_not_touch():
    road = box(0.0, 0.0, 0.0, 4.0, 2.0)
    assert overlapping(road, box(0.0, 0.0, 0.3, 4.0, 2.0, z=1.9)).all()
    assert not overlapping(road, box(0.0, 0.0, 0.3, 4.0, 2.0, z=2.1)).any()


def test_a_tilted_box_is_higher():
    pitch = np.radians(30.0)
    pose = poses([0.0], 0.0, 0.0)
    pose[0, :3, :3] = [[np.cos(pitch), 0.0, -np.sin(pitch)], [0.0, 1.0, 0.0], [np.sin(pitch), 0.0, np.cos(pitch)]]
    boxes = upright_boxes(pose, np.array([10.0, 2.0, 1.0]))
    np.testing.assert_allclose(boxes.half, [[5.0, 1.0, 2.5 + 0.5 * np.cos(pitch)]])
    np.testing.assert_allclose(boxes.forward, [[1.0, 0.0]])


def test_objects_that_are_absent_have_poses_that_mean_nothing():
    boxes, present = other_boxes([], 3)
    assert boxes.centre.shape == (0, 3, 3) and present.shape == (0, 3)


coordinate = st.floats(-6.0, 6.0)
angle = st.floats(-np.pi, np.pi)
side = st.floats(0.5, 6.0)
boxes = st.builds(box, coordinate, coordinate, angle, side, side)


@given(boxes, boxes)
def test_overlap_agrees_with_a_grid_of_points(a, b):
    steps = np.linspace(-1.0, 1.0, 61)
    grid = np.stack(np.meshgrid(steps * a.half[0, 0], steps * a.half[0, 1]), axis=-1).reshape(-1, 2)
    points = a.centre[0, :2] + grid[:, :1] * a.forward[0] + grid[:, 1:] * a.left[0]
    found = overlapping(a, b)[0]
    if inside(b, points, 0.0).any():
        assert found
    if not inside(b, points, 0.15).any():  # the diagonal of a cell of the grid
        assert not found


@given(boxes, boxes, st.floats(-8.0, 8.0), st.floats(-8.0, 8.0))
def test_boxes_touch_at_the_time_to_contact_and_not_before(a, b, vx, vy):
    velocity = np.array([[vx, vy, 0.0]])
    time = time_to_contact(a, b, velocity)[0]
    assert (time == 0.0) == overlapping(a, b)[0]

    def at(seconds: float, slack: float = 0.0) -> bool:
        return bool(overlapping(a, OrientedBoxes(b.centre + seconds * velocity, b.forward, b.half + slack))[0])

    sampled = [at(seconds) for seconds in np.linspace(0.0, 5.0, 101)]
    if time == np.inf:
        assert not any(sampled)
    elif time > 0.0:
        assert at(time, slack=1e-6) and not any(at(time * fraction) for fraction in (0.5, 0.9, 0.999))


def test_the_time_to_contact_counts_heights():
    a, above = box(0.0, 0.0, 0.0, 4.0, 2.0), box(14.0, 0.0, 0.0, 4.0, 2.0, z=5.0)
    towards = np.array([[-10.0, 0.0, 0.0]])
    assert time_to_contact(a, box(14.0, 0.0, 0.0, 4.0, 2.0), towards)[0] == pytest.approx(1.0)
    assert time_to_contact(a, above, towards)[0] == np.inf
    assert time_to_contact(a, above, np.array([[-10.0, 0.0, -4.0]]))[0] == pytest.approx(1.0)
