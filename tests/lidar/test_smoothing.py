"""Smooth paths: exact where places are, robust where some are wrong."""

import numpy as np
import pytest

from drivesplat.lidar.objects.smoothing import smooth_path

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


def test_errors_that_last_for_half_a_second_do_not_bend_the_path():
    """A cyclist at constant speed whom somebody passes: what counts is how far a place lies off its neighbours half
    a second before and after."""
    seconds = np.arange(0.0, 8.01, 0.05)
    truth = np.stack([4.2 * seconds, 0.3 * np.sin(0.3 * seconds)], axis=1)
    bends = []
    for seed in range(5):
        path = smooth_path(seconds, of_scans(truth, 20.0, seed), np.full(truth.shape, 10.0))
        off = path.places(seconds) - truth
        bends.append(off[10:-10] - 0.5 * (off[:-20] + off[20:]))
    assert np.sqrt(np.mean(np.square(bends))) < 0.025


@pytest.mark.parametrize("weight", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("duration", [0.1, 0.3, 1.0, 20.0])
def test_a_straight_way_far_from_the_origin_is_reproduced(duration, weight):
    seconds = np.arange(0.0, duration + 0.01, 0.05)
    places = np.array([1000.0, -2000.0]) + np.outer(seconds, [8.0, -3.0])
    path = smooth_path(seconds, places, np.full(places.shape, weight))
    np.testing.assert_allclose(path.places(seconds), places, atol=0.02)
    later = path.places(seconds[-1:] + 0.5)[0]
    np.testing.assert_allclose(later, places[-1] + np.array([4.0, -1.5]), atol=0.05)


def test_few_noisy_places_make_no_sharp_turn():
    """Three scans of a car at 10 m/s: half a second later it is where it would go straight on."""
    seconds, noise = np.array([0.0, 0.05, 0.1]), np.array([[0.0, 0.03], [0.0, -0.03], [0.0, 0.03]])
    path = smooth_path(seconds, np.outer(seconds, [10.0, 0.0]) + noise, np.full((3, 2), 3.0))
    assert np.linalg.norm(path.places(np.array([0.6])) - [[6.0, 0.0]]) < 1.0
