"""Smooth paths: exact where places are, robust where some are wrong."""

import numpy as np

from drivesplat.discovery.smoothing import smooth_path

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


def test_places_of_little_weight_yield_to_others():
    places = np.zeros((50, 2))
    places[::2, 0] = 0.2
    trusted = np.where(np.arange(50)[:, None] % 2 == 0, 0.01, 1.0) * np.ones((50, 2))
    assert np.abs(smooth_path(SECONDS, places, trusted).places(SECONDS)).max() < 0.02


def test_two_places_are_enough():
    path = smooth_path(np.array([1.0, 1.5]), np.array([[0.0, 1.0], [1.0, 1.0]]), weights(2))
    np.testing.assert_allclose(path.places(np.array([1.0, 1.5])), [[0.0, 1.0], [1.0, 1.0]], atol=0.05)
