"""Places that stay occupied, which nothing passes through."""

import numpy as np
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.objects.boxes import Discovered, smooth_path
from drivesplat.lidar.objects.clusters import Cluster
from drivesplat.lidar.objects.standing import StandingMap
from drivesplat.scene.object_class import ObjectClass

SECONDS = 0.3 * np.arange(14)
VAN = Mover((15.2, 0.0), (0.0, 0.0), size=(6.0, 2.0, 2.4))


def standing(*movers: Mover) -> StandingMap:
    scans = street_scans(movers, SECONDS, 2.0)
    met = [(scan.objects_met >= 0) & (scan.objects_met < len(movers) - 1) for scan in scans]
    return StandingMap(scans, met, lambda place: 0.0)


def box_along(start: tuple[float, float], end: tuple[float, float]) -> Discovered:
    """A car that drives straight from one place to another one, from second 1.8 to 2.2."""
    seconds = np.linspace(1.8, 2.2, 5)
    places = np.linspace(start, end, 5)
    heading = np.arctan2(end[1] - start[1], end[0] - start[0])
    path = smooth_path(seconds, places, np.ones((5, 2)))
    return Discovered(ObjectClass.CAR, np.array([4.5, 1.8, 1.5]), path, seconds, np.full(5, heading), np.zeros(5), 50)


def test_a_way_through_a_parked_van_is_blocked_and_one_beside_it_is_not():
    around = standing(VAN)
    assert around.blocked_share(box_along((11.0, 0.0), (15.0, 0.0))) > 0.05
    assert around.blocked_share(box_along((11.0, 5.0), (15.0, 5.0))) == 0.0


def test_an_object_does_not_block_its_own_way():
    car = Mover((8.0, -3.0), (7.0, 0.0))
    around = standing(car)  # nothing is known to move
    own = Discovered(
        ObjectClass.CAR, np.array(car.size), smooth_path(SECONDS, car.at(SECONDS), np.ones((14, 2))), SECONDS,
        np.zeros(14), np.zeros(14), 100,
    )  # fmt: skip
    assert around.blocked_share(own) == 0.0


def test_clusters_before_and_behind_a_wall_are_no_link():
    def at(place: tuple[float, float], seconds: float) -> Cluster:
        return Cluster(0, seconds, np.array([[*place, z] for z in (0.4, 0.8, 1.2)]), np.zeros(3))

    around = standing(VAN)
    assert around.blocked_link(at((11.0, 0.0), 1.9), at((14.0, 0.0), 2.1))
    assert not around.blocked_link(at((11.0, 5.0), 1.9), at((14.0, 5.0), 2.1))
