"""Objects that pass each other: whose returns are whose."""

import numpy as np
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.objects.boxes import Discovered, smooth_path
from drivesplat.lidar.objects.clusters import Chain, Cluster
from drivesplat.lidar.objects.discover import continues, discovered
from drivesplat.lidar.objects.separation import beyond, separated
from drivesplat.scene.object_class import ObjectClass

SECONDS = 0.1 * np.arange(45)


def box_at(x: float, seconds: tuple[float, float] = (0.0, 1.0), length: float = 2.0) -> Discovered:
    """A box of 2 m x 1 m with its centre at (x, 0), which faces x."""
    times = np.linspace(*seconds, 5)
    path = smooth_path(times, np.tile([x, 0.0], (5, 1)), np.ones((5, 2)))
    return Discovered(ObjectClass.CAR, np.array([length, 1.0, 1.5]), path, times, np.zeros(5), np.zeros(5), 10)


def cluster_at(*xs: float, scan: int = 0) -> Cluster:
    points = np.array([[x, 0.0, 0.5] for x in xs])
    return Cluster(scan, 0.5, points, np.array([-20.0, 0.0, 2.0]))


def xs_of(chain: Chain) -> list[list[float]]:
    return [sorted(cluster.points[:, 0].tolist()) for cluster in chain.clusters]


def test_distances_count_from_the_sides_of_a_box():
    box = box_at(0.0)
    found = beyond(box, box.poses(np.array([0.5]))[0], cluster_at(0.0, 0.9, 1.5, -3.0).points)
    np.testing.assert_allclose(found, [-0.5, -0.1, 0.5, 2.0], atol=1e-6)


def test_a_cluster_of_two_objects_is_split_between_their_boxes():
    both = cluster_at(-0.5, 0.0, 0.5, 2.0, 2.5, 3.0)
    first, second = Chain([both]), Chain([cluster_at(2.2, 2.4, 2.6, scan=1)])
    one, other = separated([first, second], [box_at(0.0), box_at(2.5)])
    assert xs_of(one) == [[-0.5, 0.0, 0.5]]
    assert xs_of(other) == [[2.0, 2.5, 3.0], [2.2, 2.4, 2.6]]


def test_what_no_other_box_reaches_stays():
    chain, far = Chain([cluster_at(-3.0, 0.0, 1.0, 9.0)]), Chain([cluster_at(30.0, 30.5, 31.0)])
    one, other = separated([chain, far], [box_at(0.0), box_at(30.5)])
    assert xs_of(one) == [[-3.0, 0.0, 1.0, 9.0]] and xs_of(other) == [[30.0, 30.5, 31.0]]


def test_a_box_of_another_time_takes_nothing():
    chain, later = Chain([cluster_at(0.0, 0.5, 1.0)]), Chain([cluster_at(0.0, 0.5, 1.0, scan=7)])
    one, _ = separated([chain, later], [box_at(0.0), box_at(0.5, seconds=(2.0, 3.0))])
    assert xs_of(one) == [[0.0, 0.5, 1.0]]


def test_too_few_returns_are_no_cluster():
    chain, other = Chain([cluster_at(0.0, 0.2, 0.4, 2.5)]), Chain([cluster_at(2.2, 2.6, 2.8, scan=1)])
    one, two = separated([chain, other], [box_at(0.0), box_at(2.5)])
    assert xs_of(one) == [[0.0, 0.2, 0.4]] and xs_of(two) == [[2.2, 2.6, 2.8]]


def test_a_cyclist_and_a_person_who_pass_each_other_keep_their_ways_and_sizes():
    cyclist = Mover((9.0, -4.0), (3.5, 0.0), size=(1.8, 0.6, 1.7))
    person = Mover((18.0, -3.2), (-1.3, 0.0), size=(0.5, 0.5, 1.75))
    found = discovered(street_scans([cyclist, person], SECONDS, 1.0))
    by_class = {item.object_class: item for item in found}
    assert len(found) == 2 and by_class.keys() == {ObjectClass.BICYCLE, ObjectClass.PEDESTRIAN}
    np.testing.assert_allclose(by_class[ObjectClass.PEDESTRIAN].size, [0.5, 0.5, 1.75], atol=0.2)
    passing = np.linspace(1.5, 2.2, 8)  # they are beside each other at 1.9 s
    for mover, kind in ((cyclist, ObjectClass.BICYCLE), (person, ObjectClass.PEDESTRIAN)):
        apart = by_class[kind].poses(passing)[:, :2, 3] - mover.at(passing)
        assert np.linalg.norm(apart, axis=1).max() < 0.25


def driving(seconds: np.ndarray, start: float, speed: float = 6.0, aside: float = 0.0) -> Discovered:
    """A car that drives along x, at `start` at second 0."""
    places = np.stack([start + speed * seconds, np.full(len(seconds), aside)], axis=1)
    zeros = np.zeros(len(seconds))
    path = smooth_path(seconds, places, np.ones((len(seconds), 2)))
    return Discovered(ObjectClass.CAR, np.array([4.5, 1.8, 1.5]), path, seconds, zeros, zeros, 100)


def test_a_box_goes_on_as_another_one():
    first, later = np.linspace(0.0, 2.0, 11), np.linspace(2.6, 5.0, 13)
    before = driving(first, 0.0)
    assert continues(before, driving(later, 1.0))
    assert not continues(before, driving(later, 8.0)), "the next car"
    assert not continues(before, driving(later, 0.0, aside=3.0)), "the next lane"
    assert not continues(before, driving(later, 27.0, speed=-6.0)), "oncoming"
    assert not continues(driving(later, 0.0), before), "earlier"
