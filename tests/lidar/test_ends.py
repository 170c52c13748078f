"""Objects are followed where nothing tells that they move: at both ends of a drive, as long as returns are there."""

import numpy as np
import pytest
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.discover import discovered
from drivesplat.lidar.objects.ends import MAX_BEYOND_S, Ends

SECONDS = np.arange(0.1, 4.05, 0.1)
AHEAD = Mover((12.0, 0.0), (8.0, 0.0))


@pytest.fixture(scope="module")
def scans():
    return street_scans([AHEAD], SECONDS)


@pytest.fixture(scope="module")
def found(scans) -> Discovered:
    (item,) = discovered(scans)
    return item


def between(item: Discovered, first: float, last: float) -> Discovered:
    """The object as if it had been seen in this time alone."""
    kept = (item.seconds >= first) & (item.seconds <= last)
    columns = {name: getattr(item, name)[kept] for name in ("seconds", "headings", "grounds")}
    return Discovered(item.object_class, item.size, item.path, returns=item.returns, **columns)


def test_a_car_that_drives_away_is_seen_until_the_last_scan(found):
    assert found.seconds[-1] == pytest.approx(SECONDS[-1], abs=0.1)
    assert found.seconds[0] <= SECONDS[0] + 0.1 and (np.diff(found.seconds) > 0).all()
    place = found.poses(found.seconds[-1:])[0, :2, 3]
    np.testing.assert_allclose(place, AHEAD.at(found.seconds[-1:])[0], atol=0.3)


def test_it_is_followed_for_a_moment_alone(scans, found):
    followed = Ends(scans).followed(between(found, 1.5, 2.5))
    assert 2.5 + 0.5 * MAX_BEYOND_S < followed.seconds[-1] <= 2.5 + MAX_BEYOND_S
    assert 1.5 - MAX_BEYOND_S <= followed.seconds[0] < 1.5 - 0.5 * MAX_BEYOND_S
    assert len(followed.seconds) == len(followed.headings) == len(followed.grounds)


def test_it_is_not_followed_where_nothing_is(scans, found):
    """From the 25th scan on the street is empty."""
    vanishing = [*scans[:25], *street_scans([], SECONDS)[25:]]
    item = between(found, 1.0, SECONDS[24])
    assert Ends(vanishing).followed(item).seconds[-1] <= SECONDS[24] < Ends(scans).followed(item).seconds[-1] - 0.2
