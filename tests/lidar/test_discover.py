"""Moving objects found in the scans of a street: how many, where, how large, and what is none."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.objects.boxes import Discovered
from drivesplat.lidar.objects.clusters import Chain, Cluster
from drivesplat.lidar.objects.discover import Surroundings, discovered
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan

SECONDS = 0.1 * np.arange(33)
LONG = 0.1 * np.arange(45)


def found_in(*movers: Mover, speed: float = 5.0, seconds: np.ndarray = SECONDS) -> list[Discovered]:
    return discovered(street_scans(movers, seconds, speed))


def offsets(item: Discovered, mover: Mover, seconds: np.ndarray | None = None) -> np.ndarray:
    """How far the centre is ahead of the true one, and to its left (metres), while it is seen."""
    times = item.seconds if seconds is None else seconds
    apart = item.poses(times)[:, :2, 3] - mover.at(times)
    cos, sin = np.cos(mover.heading), np.sin(mover.heading)
    return apart @ np.array([[cos, -sin], [sin, cos]])


@pytest.mark.parametrize(
    "mover",
    [
        pytest.param(Mover((12.0, 0.0), (7.0, 0.0)), id="ahead", marks=pytest.mark.slow),
        pytest.param(Mover((55.0, 3.5), (-10.0, 0.0)), id="oncoming", marks=pytest.mark.slow),
        pytest.param(Mover((14.0, -8.0), (2.0, 4.0)), id="crossing", marks=pytest.mark.slow),
        pytest.param(Mover((14.0, 0.5), (7.0, 0.0), size=(8.5, 2.5, 3.2)), id="truck"),
    ],
)
def test_a_vehicle_is_found_with_its_place_heading_and_size(mover):
    (item,) = found_in(mover, seconds=LONG)
    assert item.object_class in (ObjectClass.CAR, ObjectClass.TRUCK)
    assert (item.object_class is ObjectClass.TRUCK) == (mover.size[0] > 6.0)
    along, across = np.median(np.abs(offsets(item, mover)), axis=0)
    assert along < 0.35 and across < 0.3
    np.testing.assert_allclose(item.size, mover.size, atol=0.8)
    poses = item.poses(item.seconds)
    headings = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) - mover.heading
    assert np.degrees(np.median(np.abs((headings + np.pi) % (2.0 * np.pi) - np.pi))) < 3.0
    assert np.median(np.abs(poses[:, 2, 3] - 0.5 * mover.size[2])) < 0.35


def test_an_object_is_confirmed_where_one_beam_meets_it_and_most_scans_lack_the_ground():
    """A wet road returns little. Where the ground is unknown, no return can be taken for one of the ground."""
    car = Mover((20.0, 3.0), (8.0, 0.0))
    dry, *wet = street_scans([car], SECONDS[:9], 7.0)
    scans = [dry, *(_without_ground(scan) for scan in wet)]
    surroundings = Surroundings(scans, [scan.objects_met == 0 for scan in scans])
    clusters = [_of_the_lowest_beam(scan, number) for number, scan in enumerate(scans)]
    assert surroundings.confirm(Chain(clusters))


def _of_the_lowest_beam(recorded: RecordedScan, number: int) -> Cluster:
    """The returns of object 0 that lie within a decimetre of the lowest."""
    points = recorded.points()[recorded.objects_met == 0]
    points = points[points[:, 2] < points[:, 2].min() + 0.1]
    return Cluster(number, recorded.seconds, points, recorded.sensor_to_world[:3, 3])


def _without_ground(recorded: RecordedScan) -> RecordedScan:
    own = recorded.scan
    above = own.rays.directions()[..., 2] * own.ranges + recorded.sensor_to_world[2, 3]
    returned = own.returned & (above > 0.1)
    return replace(recorded, scan=replace(own, returned=returned, ranges=np.where(returned, own.ranges, 0.0)))


def test_a_person_is_found_as_one():
    person = Mover((16.0, -6.0), (0.3, 1.3), size=(0.5, 0.5, 1.75))
    (item,) = found_in(person, speed=2.0)
    assert item.object_class is ObjectClass.PEDESTRIAN
    assert np.median(np.abs(offsets(item, person))) < 0.15 and abs(item.size[2] - 1.75) < 0.4


@pytest.mark.parametrize("speed", [8.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_where_nothing_moves_nothing_is_found(speed):
    parked = [Mover((8.0 + 7.0 * i, side), (0.0, 0.0)) for i in range(5) for side in (-5.0, 5.0)]
    assert found_in(*parked, speed=speed) == []


@pytest.mark.slow
def test_cars_side_by_side_and_one_behind_the_other_are_two():
    side = [Mover((14.0, 1.8), (7.0, 0.0)), Mover((14.5, -1.8), (7.0, 0.0))]
    assert len(found_in(*side)) == 2
    queue = [Mover((12.0, 0.0), (7.0, 0.0)), Mover((21.0, 3.0), (7.5, 0.0))]
    found = found_in(*queue)
    assert len(found) == 2
    for mover in queue:
        assert min(np.median(np.abs(offsets(item, mover))) for item in found) < 0.35


def test_an_object_that_was_hidden_is_one():
    """A wall of parked vans hides an oncoming car for a while."""
    vans = [Mover((22.0, 3.0), (0.0, 0.0), size=(7.0, 2.0, 2.6))]
    car = Mover((52.0, 6.5), (-11.0, 0.0))
    found = found_in(car, *vans)
    assert len(found) == 1 and np.median(np.abs(offsets(found[0], car))) < 0.35


def test_key_frames_alone_suffice_for_what_is_seen_long():
    """Two scans a second, five seconds."""
    ahead = Mover((12.0, 0.0), (6.0, 0.0))
    (item,) = found_in(ahead, seconds=0.5 * np.arange(11))
    along, across = np.median(np.abs(offsets(item, ahead)), axis=0)
    assert along < 0.4 and across < 0.2
