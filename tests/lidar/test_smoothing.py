"""Smooth paths: exact where places are, robust where some are wrong."""

import numpy as np
import pytest

from drivesplat.lidar.objects.boxes import smooth_path

SECONDS = 0.1 * np.arange(50)


def weights(count: int) -> np.ndarray:
    return np.ones((count, 2))


def test_a_straight_way_is_reproduced_and_continued():
    places = np.stack([3.0 + 4.0 * SECONDS, -1.0 - 0.5 * SECONDS], axis=1)
    path = smooth_path(SECONDS, places, weights(50))
    np.testing.assert_allclose(path.places(SECONDS), places, atol=1e-3)
    np.testing.assert_allclose(path.velocities(SECONDS), np.broadcast_to([4.0, -0.5], (50, 2)), atol=5e-3)
    np.testing.assert_allclose(path.places(np.array([-1.0, 6.0])), [[-1.0, -0.5], [27.0, -4.0]], atol=2e-2)


def test_noise_is_averaged_and_outliers_have_little_effect():
    rng = np.random.default_rng(0)
    truth = np.stack([5.0 * SECONDS, 2.0 * np.sin(0.8 * SECONDS)], axis=1)
    places = truth + rng.normal(0.0, 0.1, truth.shape)
    places[10:13] += 2.0
    off = np.abs(smooth_path(SECONDS, places, weights(50)).places(SECONDS) - truth)
    assert np.median(off) < 0.06 and off.max() < 0.35


def test_two_places_are_enough():
    path = smooth_path(np.array([1.0, 1.5]), np.array([[0.0, 1.0], [1.0, 1.0]]), weights(2))
    np.testing.assert_allclose(path.places(np.array([1.0, 1.5])), [[0.0, 1.0], [1.0, 1.0]], atol=0.05)


def of_scans(truth: np.ndarray, per_second: float, seed: int) -> np.ndarray:
    """Places with noise, and with errors that last for half a second, as of a side that is hidden for a while."""
    rng = np.random.default_rng(seed)
    lasting = max(1, round(0.5 * per_second))
    shifts = np.repeat(rng.normal(0.0, 0.06, (len(truth) // lasting + 1, 2)), lasting, axis=0)[: len(truth)]
    return truth + rng.normal(0.0, 0.04, truth.shape) + shifts


@pytest.mark.parametrize("per_second", [20.0, 2.0])
def test_a_vehicle_that_brakes_hard_is_followed(per_second):
    """From 12 m/s with 6 m/s² to a stop."""
    seconds = np.arange(0.0, 8.01, 1.0 / per_second)
    braking = np.clip(seconds - 2.0, 0.0, 2.0)
    truth = np.stack([12.0 * np.minimum(seconds, 2.0) + 12.0 * braking - 3.0 * braking**2, 0.0 * seconds], axis=1)
    for seed in range(3):
        path = smooth_path(seconds, of_scans(truth, per_second, seed), np.full(truth.shape, 10.0))
        assert np.linalg.norm(path.places(seconds) - truth, axis=1).max() < 0.3
