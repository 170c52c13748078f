"""Scale of a model made from images along a drive, and its alignment to recorded poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.from_images import align_poses, depth_at, enough_from_lidar, scale_drift
from drivesplat.scene.rigid import rigid
from drivesplat.settings.refine_poses import PriorSettings


def test_drift_compares_segments_and_ignores_single_images():
    steady = np.full(40, 5.0)
    assert scale_drift(steady) == 1.0
    steady[[3, 17, 30]] = [50.0, np.nan, 0.1]
    assert scale_drift(steady) == 1.0
    assert scale_drift(5.0 * np.linspace(1.0, 1.5, 40)) == pytest.approx((1.5 - 0.5 * 2 / 39) / (1 + 0.5 * 2 / 39))
    assert scale_drift(np.array([2.0, 3.0])) == 1.0


def test_lidar_needs_a_minimum_fraction_of_images():
    assert enough_from_lidar(np.array([1.0, np.nan, np.nan, np.nan]))
    assert not enough_from_lidar(np.array([1.0, *[np.nan] * 4]))


def plane(pixels: np.ndarray) -> np.ndarray:
    """The inverse of depth (n,) at pixels (n, 2)."""
    return 0.02 + pixels @ np.array([0.001, 0.0005])


def test_depth_between_returns_on_a_plane_is_exact():
    """Depth z of a plane n x = d at the pixel u, v is d / (n (u, v, 1)): its inverse is linear in the pixels."""
    rng = np.random.default_rng(0)
    pixels, wanted = rng.uniform(0.0, 100.0, (300, 2)), rng.uniform(20.0, 80.0, (50, 2))
    depth = depth_at(wanted, pixels, 1.0 / plane(pixels), np.full((300, 2), 15.0))
    np.testing.assert_allclose(depth, 1.0 / plane(wanted), rtol=1e-9)
    far = depth_at(wanted, pixels, np.ones(300), np.full((300, 2), 1e-3))
    assert np.isnan(far).all()
    on_a_line = np.stack([np.arange(300.0)] * 2, axis=1)
    assert np.isnan(depth_at(wanted, on_a_line, np.ones(300), np.full((300, 2), 15.0))).all()
    assert np.isnan(depth_at(wanted, pixels[:5], np.ones(5), np.full((5, 2), 15.0))).all()


def test_alignment_takes_the_roll_from_rotations_and_the_rest_from_positions():
    """On a straight road positions say nothing of the roll; recorded pitch is biased by a degree, and positions say
    so."""
    straight = np.tile(np.eye(4), (20, 1, 1))
    straight[:, 0, 3] = 8.0 * np.arange(20)
    away = rigid(Rotation.from_euler("zyx", [70.0, 10.0, -25.0], degrees=True).as_matrix(), np.array([5.0, -80.0, 3.0]))
    assert np.abs(align_poses(straight, away @ straight, PriorSettings()) - straight).max() < 1e-9
    pitched = straight @ rigid(Rotation.from_euler("y", 1.0, degrees=True).as_matrix(), np.zeros(3))
    pose = align_poses(pitched, away @ straight, PriorSettings())
    assert np.abs(pose - straight).max() < 0.01, "its far end is not lifted"
