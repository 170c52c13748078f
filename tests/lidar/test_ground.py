"""The ground by LiDAR points: heights, and the planes that lie on it."""

import numpy as np
import pytest

from drivesplat.lidar.ground import GroundMap


def plane_points(slope: tuple[float, float], count: int = 6000, noise: float = 0.02) -> np.ndarray:
    """Points (count, 3) on a plane through the origin that rises by `slope` metres per metre along x and y."""
    random = np.random.default_rng(0)
    places = random.uniform(-20.0, 20.0, (count, 2))
    return np.column_stack([places, places @ np.array(slope) + random.normal(0.0, noise, count)])


def heights_of(ground: GroundMap, places: np.ndarray) -> np.ndarray:
    """The heights of the nearest planes at places (m, 2)."""
    planes = ground.planes()
    nearest = np.linalg.norm(places[:, None] - planes.places, axis=2).argmin(axis=1)
    normals, offsets = planes.normals[nearest], planes.offsets[nearest]
    return (offsets - (normals[:, :2] * places).sum(axis=1)) / normals[:, 2]


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.1, 0.0), (-0.05, 0.08)])
def test_planes_lie_on_an_even_ground(slope):
    """Amid the points, which are noisy by 2 cm: a plane as low as the lowest of them shifts all that is seen on it."""
    ground = GroundMap(plane_points(slope))
    places = np.random.default_rng(1).uniform(-15.0, 15.0, (200, 2))
    errors = heights_of(ground, places) - places @ np.array(slope)
    assert np.abs(errors).max() < 0.04 and abs(errors.mean()) < 0.002
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.linalg.norm([*slope, 1.0])
    assert (ground.planes().normals @ normal > np.cos(np.radians(3.0))).all()


def test_heights_are_between_those_of_the_cells_around():
    ground = GroundMap(plane_points((0.1, 0.0)))
    assert ground.height(np.array([10.0, 0.0])) == pytest.approx(1.0, abs=0.15)
    assert np.isnan(ground.height(np.array([60.0, 0.0])))


def test_what_stands_on_the_ground_does_not_lift_it():
    """A wall, a roof of 4 m x 4 m under which no ground is seen, and leaves."""
    random = np.random.default_rng(2)
    ground = plane_points((0.0, 0.0))
    below_roof = (np.abs(ground[:, :2] - 5.0) < 2.0).all(axis=1)
    roof = np.column_stack([random.uniform(3.0, 7.0, (800, 2)), np.full(800, 1.5)])
    wall = np.column_stack([np.full(900, -8.0), random.uniform(-20, 20, 900), random.uniform(0.0, 6.0, 900)])
    leaves = np.column_stack([random.uniform(-3.0, 3.0, (500, 2)), random.uniform(3.0, 5.0, 500)])
    found = GroundMap(np.concatenate([ground[~below_roof], roof, wall, leaves]))
    assert np.abs(heights_of(found, found.planes().places)).max() < 0.2, "no plane lies on the roof"
    places = random.uniform(-15.0, 15.0, (200, 2))
    assert np.abs(heights_of(found, places)).max() < 0.12


def test_a_step_as_of_a_kerb_stays_a_step():
    """Beside it planes are flat; only within their radius they lean."""
    points = plane_points((0.0, 0.0))
    points[points[:, 1] > 0.0, 2] += 0.15
    ground = GroundMap(points)
    along = np.linspace(-15.0, 15.0, 40)
    for aside, height in ((-2.0, 0.0), (2.0, 0.15)):
        found = heights_of(ground, np.column_stack([along, np.full(40, aside)]))
        np.testing.assert_allclose(found, height, atol=0.08)


def test_without_points_nothing_is_known():
    ground = GroundMap(np.zeros((0, 3)))
    assert np.isnan(ground.height(np.zeros(2))) and len(ground.planes().places) == 0
