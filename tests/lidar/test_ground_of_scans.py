"""The map of the ground that scans see."""

import numpy as np
import pytest
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.ground import GroundMap
from drivesplat.lidar.objects.discover import GROUND_SCANS, ground_of

SECONDS = 0.1 * np.arange(31)


def ground_below(*movers: Mover, seconds: np.ndarray = SECONDS, speed: float = 10.0) -> GroundMap:
    scans = street_scans(movers, seconds, speed)
    return ground_of(scans, [scan.objects_met >= 0 for scan in scans])


def test_the_ground_far_ahead_is_known_from_scans_that_were_nearer():
    """At 50 m the beams of the first scan are more than three metres apart. The vehicle drives 30 m."""
    far = np.array([50.0, 3.0])
    assert ground_below().height(far) == pytest.approx(0.0, abs=0.05)
    assert np.isnan(ground_below(seconds=SECONDS[:1]).height(far))


def test_returns_of_moving_objects_are_not_ground():
    """All that is seen within three metres of the middle of a flat trailer is its top, 0.5 m above the road."""
    trailer = Mover((16.0, 0.0), (10.0, 0.0), size=(12.0, 8.0, 0.5))
    middle, seconds = np.array([16.0, 0.0]), SECONDS[:3]
    scans = street_scans([trailer], seconds, 10.0)
    standing = [np.zeros(len(scan.objects_met), dtype=bool) for scan in scans]
    assert ground_of(scans, standing).height(middle) == pytest.approx(0.5, abs=0.1)
    assert np.isnan(ground_below(trailer, seconds=seconds).height(middle))


def test_where_nothing_was_returned_the_ground_is_unknown():
    assert np.isnan(ground_below().height(np.array([0.0, 200.0])))


def test_long_drives_are_sampled_from_begin_to_end():
    """Places near the first and the last scan are known, however many scans there are."""
    seconds = 0.05 * np.arange(GROUND_SCANS + 40)
    ground = ground_below(seconds=seconds, speed=20.0)
    for ahead in (5.0, 20.0 * seconds[-1] + 15.0):
        assert ground.height(np.array([ahead, 2.0])) == pytest.approx(0.0, abs=0.05)
