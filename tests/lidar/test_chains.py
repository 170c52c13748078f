"""Clusters, chains over time, and chains of one object."""

import numpy as np
import pytest

from drivesplat.lidar.objects.chains import chains_of
from drivesplat.lidar.objects.clusters import Chain, Cluster, connected
from drivesplat.lidar.objects.merging import after_gaps


def cluster(scan: int, place: tuple[float, float], seconds: float | None = None) -> Cluster:
    """Four returns around a place, of ten scans a second."""
    corners = np.array([[-0.2, -0.2, 0.5], [0.2, -0.2, 0.5], [-0.2, 0.2, 1.0], [0.2, 0.2, 1.0]])
    return Cluster(scan, 0.1 * scan if seconds is None else seconds, corners + np.array([*place, 0.0]), np.zeros(3))


def chain(scans: range, start: tuple[float, float], velocity: tuple[float, float]) -> Chain:
    return Chain([cluster(k, (start[0] + 0.1 * k * velocity[0], start[1] + 0.1 * k * velocity[1])) for k in scans])


def test_returns_are_connected_within_a_reach_that_grows_with_the_range():
    places = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [3.0, 0.0], [3.9, 0.0]])
    near, far = connected(places, np.full(5, 5.0)), connected(places, np.full(5, 40.0))
    assert near[0] == near[1] == near[2] != near[3] != near[4] and far[3] == far[4] != far[2]


def test_objects_that_pass_each_other_keep_their_chains():
    scans = [[cluster(k, (0.5 * k, 0.0)), cluster(k, (15.0 - 0.5 * k, 1.5))] for k in range(30)]
    found = chains_of(scans)
    assert [len(one.clusters) for one in found] == [30, 30]
    for one in found:
        assert np.ptp(one.places[:, 1]) < 1e-9


def test_a_chain_goes_on_after_a_short_gap_and_ends_after_a_long_one():
    def lengths(missing: range) -> list[int]:
        scans = [[] if k in missing else [cluster(k, (0.6 * k, 0.0))] for k in range(40)]
        return sorted(len(one.clusters) for one in chains_of(scans))

    assert lengths(range(10, 14)) == [36] and lengths(range(10, 30)) == [10, 10]


@pytest.mark.parametrize(("velocity", "joined"), [((6.0, 0.0), 1), ((-6.0, 0.0), 2)])
def test_chains_are_joined_where_one_goes_on_as_the_other_ended(velocity, joined):
    before = chain(range(12), (0.0, 0.0), (6.0, 0.0))
    start = 0.0 if velocity[0] > 0 else 24.0
    after = chain(range(25, 40), (start, 0.3), velocity)
    found = after_gaps([after, before])
    assert len(found) == joined
    assert joined == 2 or (np.diff(found[0].seconds) > 0.0).all()


def test_a_chain_takes_the_cluster_that_looks_like_its_own():
    """Where a car was expected lies a leaf, and the car a little beside."""
    grid = np.stack(np.meshgrid(np.arange(-0.9, 1.0, 0.15), [0.0], np.arange(0.4, 1.5, 0.2)), axis=-1).reshape(-1, 3)
    cars = [Cluster(k, 0.1 * k, grid + np.array([0.5 * k, 0.0, 0.0]), np.zeros(3)) for k in range(10)]
    cars.append(Cluster(10, 1.0, grid + np.array([5.3, 0.2, 0.0]), np.zeros(3)))
    found = chains_of([*([car] for car in cars[:10]), [cluster(10, (5.0, 0.0)), cars[10]]])
    assert sorted(len(one.clusters) for one in found) == [1, 11]


def test_nothing_is_faster_than_any_vehicle():
    def chained(step: float) -> int:
        return len(chains_of([[cluster(k, (step * k, 0.0))] for k in range(5)]))

    assert chained(3.0) == 1 and chained(5.0) == 5


def test_a_chain_is_not_joined_through_what_stands():
    before, after = chain(range(12), (0.0, 0.0), (6.0, 0.0)), chain(range(25, 40), (0.0, 0.3), (6.0, 0.0))
    assert len(after_gaps([before, after], lambda one, other: True)) == 2
    assert len(after_gaps([before, after], lambda one, other: False)) == 1
