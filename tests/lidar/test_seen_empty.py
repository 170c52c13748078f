"""Places that other scans saw empty or occupied, and the returns that move."""

import numpy as np
import pytest
from helpers.street_scans import HEIGHT, Mover, street_scans

from drivesplat.lidar.objects.seen_empty import BASELINES_S, RangeGrid, asked, seen_empty


def test_a_scan_sees_places_before_at_and_behind_a_surface():
    """A box stands 10 to 14 m ahead of the sensor, at x = 2 m by then."""
    (scan,) = street_scans([Mover((14.0, 0.0), size=(4.0, 2.0, 1.7))], np.array([0.4]), speed=5.0)
    places = np.array([
        [8.0, 0.0, 1.0],  # on the way
        [12.0, 0.0, 1.2],  # the face
        [15.0, 0.0, 0.8],  # within
        [8.0, 0.0, 4.0],  # above the field of view
        [12.0, 4.0, 1.0],  # beside, before the facade
        [12.0, 11.75, 1.5],  # the facade
    ])  # fmt: skip
    empty, occupied = RangeGrid(scan).seen(places)
    np.testing.assert_array_equal(empty, [True, False, False, False, True, False])
    np.testing.assert_array_equal(occupied, [False, True, False, False, False, True])


def test_a_place_is_looked_up_at_the_time_when_the_sensor_looks_there():
    """At 20 m/s the sensor moves two metres in a revolution: a pole beside the way would be missed."""
    pole = Mover((6.0, 5.0), size=(0.4, 0.4, 3.0))
    (scan,) = street_scans([pole], np.array([0.0]), speed=20.0)
    _, occupied = RangeGrid(scan).seen(np.array([[6.0, 4.8, 1.0], [6.0, 4.8, HEIGHT]]))
    assert occupied.all()


def test_returns_of_a_car_that_drives_are_told_from_all_others():
    scans = street_scans([Mover((12.0, 0.0), (7.0, 0.0)), Mover((20.0, 5.0))], 0.1 * np.arange(40))
    found, truth = seen_empty(scans), [scan.objects_met == 0 for scan in scans]
    mine, theirs = np.concatenate(found), np.concatenate(truth)
    assert (mine & theirs).sum() > 0.8 * theirs.sum() and (mine & theirs).sum() > 0.95 * mine.sum()


@pytest.mark.parametrize("rate", [20.0, 2.0])
def test_scans_some_seconds_before_and_after_are_asked(rate):
    seconds = np.arange(0.0, 10.0, 1.0 / rate)
    middle = len(seconds) // 2
    others = seconds[asked(seconds, middle)] - seconds[middle]
    assert np.abs(others).min() >= 0.2 and np.abs(others).max() <= max(BASELINES_S) + 0.3 and len(set(others)) > 7
    assert (asked(seconds, 0) > np.zeros(1)).all(), "none before the first"
    assert asked(seconds[:1], 0) == []
