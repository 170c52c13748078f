"""Where a vehicle is on a route, on paths that turn back, cross themselves, start from rest, and end."""

import math

import numpy as np
import pytest
from helpers.hand_made import about_z

from drivesplat.scene.rigid import rigid
from drivesplat.trajectories.reference_path import ReferencePath


def route_of(places: np.ndarray, seconds: np.ndarray | None = None) -> ReferencePath:
    directions = np.gradient(places, axis=0)
    turns = np.stack([about_z(math.atan2(y, x)) for x, y in directions])
    poses = rigid(turns, np.column_stack([places, np.zeros(len(places))]))
    return ReferencePath(poses, np.arange(float(len(places))) if seconds is None else seconds)


def headings_at(route: ReferencePath, arcs: list[float]) -> np.ndarray:
    directions = route.at(np.array(arcs))[1]
    return np.arctan2(directions[:, 1], directions[:, 0])


def straight(length: float, step: float) -> np.ndarray:
    return np.column_stack([np.arange(0.0, length + 1e-9, step), np.zeros(int(length / step + 1.5))])


def circle(radius: float, laps: float, step: float = 0.5) -> np.ndarray:
    angles = np.arange(0.0, laps * 2.0 * math.pi, step / radius)
    return radius * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])


@pytest.mark.parametrize("step", [0.05, 0.7, 3.0])
def test_places_are_in_equal_steps_whatever_the_speed(step):
    route = route_of(straight(42.0, step))
    places, _ = route.at(0.1 * np.arange(910))
    np.testing.assert_allclose(np.diff(places[:, 0]), 0.1, atol=1e-9)
    assert places[-1, 0] > 90.0, "continued straight on"


def test_progress_and_offset_are_not_those_of_the_nearest_place_alone():
    route = route_of(straight(40.0, 1.0))
    for x in np.linspace(5.0, 6.0, 23):
        along, aside = route.follow(np.array([x, -1.5]), 5.0, 1.0)
        assert along == pytest.approx(x, abs=1e-9) and abs(aside) == pytest.approx(1.5)


def test_a_path_that_turns_back_does_not_catch_who_drives_beside_it():
    ahead = straight(40.0, 0.5)
    back = np.concatenate([ahead, [[42.0, 1.7], [41.5, 3.2]], ahead[::-1] + np.array([0.0, 3.4])])
    route = route_of(back)
    assert route.follow(np.array([10.5, 3.3]), 10.0, 0.5)[0] == pytest.approx(10.5, abs=0.1)


def test_on_the_second_lap_a_run_begins_on_the_second_lap():
    laps = circle(15.0, 2.0)
    route = route_of(laps, 0.1 * np.arange(len(laps)))
    index = 283
    along, aside = route.follow(laps[index], route.begin(0.1 * index), 0.0)
    assert along == pytest.approx(0.5 * index, abs=0.3) and abs(aside) < 0.05
    headings = headings_at(route, [along, along + 2.0])
    assert np.angle(np.exp(1j * (headings[1] - headings[0]))) == pytest.approx(2.0 / 15.0, rel=0.1)


def test_beyond_its_end_a_route_goes_straight_on():
    route = route_of(straight(20.0, 0.5))
    np.testing.assert_allclose(route.at(np.array([19.0, 25.0, 45.0]))[0], [[19.0, 0], [25.0, 0], [45.0, 0]], atol=1e-9)
    np.testing.assert_allclose(headings_at(route, [19.0, 25.0, 45.0]), 0.0, atol=1e-9)
    assert route.follow(np.array([44.0, 1.0]), 43.5, 0.5)[0] == pytest.approx(44.0)


def test_noise_at_rest_is_no_way():
    random = np.random.default_rng(0)
    rest = 0.02 * random.standard_normal((200, 2))
    route = route_of(np.concatenate([rest, straight(20.0, 0.5)[1:]]))
    assert route.begin(float(len(rest) + 39)) == pytest.approx(20.0, abs=0.3)
    assert np.isfinite(route_of(rest).at(0.1 * np.arange(50))[0]).all()
