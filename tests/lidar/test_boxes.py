"""The box of a chain of clusters: which sides place it, and what is cut off."""

import numpy as np
from helpers.street_scans import Mover, street_scans

from drivesplat.lidar.objects.boxes import Discovered, _center, fitted_box
from drivesplat.lidar.objects.clusters import Chain, Cluster
from drivesplat.scene.scan_record import RecordedScan

SECONDS = 0.1 * np.arange(31)


def chain_of(scans: list[RecordedScan], nearest: float = 0.0) -> Chain:
    """The returns of object 0 in each scan that are `nearest` metres or more away."""
    clusters = []
    for number, recorded in enumerate(scans):
        chosen = recorded.scan.returned & recorded.measured
        met = recorded.objects_met == 0
        points, seconds = recorded.points()[met], recorded.seconds + recorded.scan.rays.offsets_s[chosen][met]
        origin = recorded.sensor_to_world[:3, 3]
        seen = np.linalg.norm(points - origin, axis=1) >= nearest
        if seen.sum() >= 3:
            clusters.append(Cluster(number, float(seconds[seen].mean()), points[seen], origin))
    return Chain(clusters)


def boxed(mover: Mover, speed: float, nearest: float = 0.0) -> Discovered:
    chain = chain_of(street_scans([mover], SECONDS, speed), nearest)
    return fitted_box(chain, np.zeros(len(chain.clusters)), nearest)


def test_returns_of_the_front_place_a_car_that_drives_towards_the_sensor_along_y():
    """The sides nearer to the sensor are seen: in the frame of the box (forward, left), not in that of the world."""
    points = np.array([[x, y, 1.0] for x in (-0.9, 0.9) for y in (21.5, 22.0)])
    cluster = Cluster(0, 0.0, points, np.array([0.0, 40.0, 1.8]))
    frame = np.array([[0.0, 1.0], [-1.0, 0.0]])
    center, _ = _center(cluster, frame, np.array([[21.5, 22.0], [-0.9, 0.9]]), np.array([4.5, 1.8]), 0.0)
    np.testing.assert_allclose(center, [22.0 - 2.25, 0.0], atol=1e-9)


def test_a_car_whose_front_is_mostly_unseen_is_placed_by_its_back():
    """Its left flank is seen from behind: whole at two times, else 85 % of it."""
    points = np.column_stack([np.linspace(0.0, 4.5, 60), np.full(60, 0.9), np.linspace(0.3, 1.5, 60)])
    clusters = []
    for number, seconds in enumerate(SECONDS):
        share = 1.0 if number in (3, 4) else 0.85
        seen = points[points[:, 0] <= share * 4.5] + [9.0 + 8.0 * seconds, -4.0, 0.0]
        clusters.append(Cluster(number, float(seconds), seen, np.array([8.0 * seconds, 0.0, 1.8])))
    found = fitted_box(Chain(clusters), np.zeros(len(clusters)))
    backs = found.poses(SECONDS)[:, 0, 3] - 0.5 * found.size[0]
    assert np.abs(backs - (9.0 + 8.0 * SECONDS)).max() < 0.1


def test_a_cyclist_who_is_too_near_to_be_measured_keeps_the_way():
    """The vehicle overtakes a cyclist at 2 m; returns within 2.5 m are missing, and with them the near side."""
    cyclist = Mover((6.0, -2.0), (4.0, 0.0), size=(1.8, 0.6, 1.7))
    found = boxed(cyclist, 8.0, nearest=2.5)
    apart = found.poses(SECONDS)[:, :2, 3] - cyclist.at(SECONDS)
    assert np.linalg.norm(apart, axis=1).max() < 0.3
