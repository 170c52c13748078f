"""Progress along a recorded path, compared with arc lengths in closed form."""

import numpy as np
import pytest
from helpers.driven_runs import poses, times

from drivesplat.trajectories.reference_path import MIN_SEGMENT, ReferencePath


def straight_path(length: float) -> ReferencePath:
    seconds = times(length / 10.0)
    return ReferencePath(poses(10.0 * seconds, 0.0, 0.0), seconds)


def test_arcs_offsets_and_tangents_of_places_beside_a_straight_path():
    places = straight_path(50.0).track(np.array([[3.0, 2.0], [7.5, -1.0], [12.0, 0.0]]), 0.0)
    np.testing.assert_allclose(places.arc, [3.0, 7.5, 12.0], atol=1e-9)
    np.testing.assert_allclose(places.offset, [2.0, -1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(places.tangent, [[1.0, 0.0]] * 3, atol=1e-12)


def test_the_path_goes_on_straight_beyond_its_ends():
    path = straight_path(20.0)
    there = np.array([[-5.0, 1.0], [4.0, 0.0], [14.0, 0.0], [24.0, 3.0]])
    places = path.track(there, 0.0)
    np.testing.assert_allclose(places.arc, [-5.0, 4.0, 14.0, 24.0], atol=1e-8)
    np.testing.assert_allclose(places.offset, [1.0, 0.0, 0.0, 3.0], atol=1e-9)
    ends = path.distances_with_ends(there, places)
    np.testing.assert_allclose(ends, [np.hypot(5.0, 1.0), 0.0, 0.0, np.hypot(4.0, 3.0)], atol=1e-8)


def test_laps_around_a_circle_add_up():
    seconds, radius = times(60.0), 15.0
    angle = 10.0 * seconds / radius  # 600 m, more than six laps
    path = ReferencePath(poses(radius * np.sin(angle), radius * (1.0 - np.cos(angle)), angle), seconds)
    assert path.length == pytest.approx(600.0, rel=0.01)
    inside = (radius - 1.0) * np.stack([np.sin(angle), -np.cos(angle)], axis=-1) + [0.0, radius]
    places = path.track(inside, 0.0)
    np.testing.assert_allclose(places.arc, 10.0 * seconds, rtol=0.01, atol=0.1)
    np.testing.assert_allclose(places.offset, 1.0, rtol=0.02)


def test_a_path_that_crosses_itself_is_followed_on_the_branch_that_is_driven():
    seconds = times(40.0)
    angle = 2.0 * np.pi * seconds / 40.0
    x, y = 60.0 * np.sin(angle), 30.0 * np.sin(2.0 * angle)  # an eight: it crosses itself at the origin after 20 s
    path = ReferencePath(poses(x, y, 0.0), seconds)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    places = path.track(np.stack([x, y], axis=-1), 0.0)
    np.testing.assert_allclose(places.arc, lengths, rtol=0.01, atol=0.1)


def test_standing_adds_no_length_and_reversing_goes_back():
    rng = np.random.default_rng(0)
    seconds = times(20.0)
    x = np.where(seconds < 10.0, 0.0, 5.0 * (seconds - 10.0))
    noise = rng.uniform(-0.05, 0.05, (2, len(seconds))) * (seconds < 10.0)
    path = ReferencePath(poses(x + noise[0], noise[1], 0.0), seconds)
    assert path.length == pytest.approx(50.0, abs=0.2)
    assert abs(path.arcs_at(np.array([9.0]))[0]) < 0.1 and MIN_SEGMENT > 0.1
    there_and_back = np.concatenate([np.arange(0.0, 20.0, 0.5), np.full(50, 20.0), np.arange(20.0, 5.0, -0.5)])
    places = path.track(np.stack([there_and_back, np.zeros(len(there_and_back))], axis=-1), 0.0)
    np.testing.assert_allclose(places.arc - places.arc[0], there_and_back, atol=0.1)


def test_a_vehicle_that_stood_has_a_path_along_its_heading():
    seconds = times(2.0)
    path = ReferencePath(poses(np.full(len(seconds), 7.0), 1.0, np.pi / 2), seconds)
    places = path.track(np.array([[7.0, 1.0], [6.0, 4.0]]), path.begin(0.0))
    assert path.length == 0.0
    np.testing.assert_allclose(places.arc, [0.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(places.offset, [0.0, 1.0], atol=1e-9)


def test_the_recorded_vehicle_is_known_while_it_was_recorded():
    path = straight_path(20.0)
    np.testing.assert_allclose(path.arcs_at(np.array([-0.1, 0.55, 2.0, 2.1])), [np.nan, 5.5, 20.0, np.nan])
    np.testing.assert_allclose(path.places_at(np.array([0.55, 3.0])), [[5.5, 0.0], [np.nan, np.nan]])
    assert path.begin(5.0) == pytest.approx(20.0)
