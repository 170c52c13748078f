"""How well the surfaces of clusters fit each other."""

import numpy as np
import pytest

from drivesplat.lidar.objects.boxes import Discovered, smooth_path
from drivesplat.lidar.objects.clusters import Chain, Cluster
from drivesplat.lidar.objects.discover import least_misfit, misfit, misfit_along
from drivesplat.scene.object_class import ObjectClass

GRID = np.stack(np.meshgrid([0.0], np.arange(0.0, 1.8, 0.1), np.arange(0.4, 1.5, 0.2)), axis=-1).reshape(-1, 3)
"""Returns from the rear of a car."""


def rear(x: float, seconds: float = 0.0, points: np.ndarray = GRID) -> Cluster:
    return Cluster(round(10 * seconds), seconds, points + np.array([x, 0.0, 0.0]), np.array([-10.0, 0.0, 1.8]))


def test_a_surface_fits_itself_after_its_shift():
    a, b = rear(0.0), rear(0.7)
    assert misfit(a, b, np.array([0.7, 0.0])) == pytest.approx(0.0, abs=1e-9)
    assert misfit(a, b, np.zeros(2)) == pytest.approx(0.7)


def test_a_surface_fits_where_a_part_of_it_is_hidden():
    hidden = rear(0.7, points=GRID[GRID[:, 1] < 0.75])
    assert least_misfit(rear(0.0), hidden) == pytest.approx(0.0, abs=1e-9)
    leaves = rear(0.7, points=np.random.default_rng(0).uniform(-1.5, 1.5, (20, 3)))
    assert least_misfit(rear(0.0), leaves) > 0.3


def test_a_surface_fits_along_its_chain_and_leaves_do_not():
    seconds = 0.1 * np.arange(8)
    path = smooth_path(seconds, np.outer(seconds, [5.0, 0.0]), np.ones((8, 2)))
    box = Discovered(ObjectClass.CAR, np.array([4.5, 1.8, 1.5]), path, seconds, np.zeros(8), np.zeros(8), 100)
    rng = np.random.default_rng(0)
    leaves = [rear(5.0 * at, at, rng.uniform(-1.0, 1.0, (8, 3))) for at in seconds]
    assert misfit_along(Chain([rear(5.0 * at, at) for at in seconds]), box) < 0.01
    assert misfit_along(Chain(leaves), box) > 0.3
