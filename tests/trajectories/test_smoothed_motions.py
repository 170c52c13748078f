"""Annotated motions are freed of noise that no vehicle follows, and of nothing else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.trajectories.motion import Motion
from drivesplat.trajectories.smoothing import JERK, MIN_INTERVAL, ORDER, POSITION_ERROR, smooth, smoothed

SECONDS = np.arange(0.0, 8.0, 0.1)


def path(times: np.ndarray) -> np.ndarray:
    """Positions (n, 3) of a vehicle that brakes and turns, on a road that rises."""
    return np.stack([9.0 * times - 0.4 * times**2, 2.0 * np.sin(0.5 * times), 0.03 * times], axis=1)


def motion(positions: np.ndarray, angles: np.ndarray, times: np.ndarray = SECONDS, runs=None) -> Motion:
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = positions
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    return Motion(times, poses, runs or ((0, len(times) - 1),), 0.05)


def headings(times: np.ndarray) -> np.ndarray:
    return np.stack([2.9 + 0.2 * times, 0.02 + 0.0 * times, 0.0 * times], axis=1)  # passes 180 degrees


def error(given: Motion, positions: np.ndarray) -> float:
    return float(np.sqrt(((given.object_to_world[:, :3, 3] - positions) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("hz", [2, 5, 10, 20])
def test_exact_annotations_hardly_change(hz):
    times = np.arange(0.0, 8.0, 1.0 / hz)
    result = smoothed(motion(path(times), headings(times), times))
    assert error(result, path(times)) < 0.005
    turned = Rotation.from_matrix(result.object_to_world[:, :3, :3]) * Rotation.from_euler("ZYX", headings(times)).inv()
    assert np.degrees(turned.magnitude()).max() < 0.1


def test_a_polynomial_of_the_second_order_is_kept():
    times = np.sort(np.random.default_rng(0).uniform(0.0, 5.0, 40))
    values = np.stack([1.0 + 2.0 * times - 3.0 * times**2, 0.0 * times], axis=1)
    np.testing.assert_allclose(smooth(times, values, 0.1, np.array([5.0, 0.5])), values, atol=1e-8)


def test_wandering_boxes_come_closer_to_the_road():
    """Up and down by 5 cm within 0.7 s, as boxes that follow the pitch of the ego vehicle."""
    wander = np.zeros((len(SECONDS), 3))
    wander[:, 2] = 0.05 * np.sin(2.0 * np.pi * SECONDS / 0.7)
    result = smoothed(motion(path(SECONDS) + wander, headings(SECONDS)))
    assert error(result, path(SECONDS)) < 0.3 * 0.05 / np.sqrt(2.0)


def test_noise_decreases_along_all_axes_and_about_them():
    random = np.random.default_rng(1)
    noise, turning = random.normal(0.0, 0.05, (len(SECONDS), 3)), random.normal(0.0, 0.02, (len(SECONDS), 3))
    noisy = motion(path(SECONDS) + noise, headings(SECONDS) + turning)
    result = smoothed(noisy)
    assert error(result, path(SECONDS)) < 0.6 * error(noisy, path(SECONDS))
    exact = Rotation.from_euler("ZYX", headings(SECONDS)).inv()
    before, after = (Rotation.from_matrix(it.object_to_world[:, :3, :3]) * exact for it in (noisy, result))
    assert after.magnitude().mean() < 0.6 * before.magnitude().mean()


def test_one_wrong_annotation_does_not_move_the_others():
    positions = path(SECONDS)
    positions[30] += [0.0, 1.5, 0.0]
    result = smoothed(motion(positions, headings(SECONDS))).object_to_world[:, :3, 3]
    others = np.abs(np.arange(len(SECONDS)) - 30) > 3
    assert np.abs(result - path(SECONDS))[others].max() < 0.05
    assert np.abs(result - path(SECONDS))[30].max() < 0.3


def test_runs_are_smoothed_apart_and_short_ones_kept():
    random = np.random.default_rng(2)
    positions = path(SECONDS) + random.normal(0.0, 0.05, (len(SECONDS), 3))
    runs = ((0, 39), (40, 40 + ORDER - 1), (40 + ORDER, len(SECONDS) - 1))
    given = motion(positions, headings(SECONDS), runs=runs)
    result = smoothed(given).object_to_world
    own = slice(40, 40 + ORDER)
    np.testing.assert_array_equal(result[own], given.object_to_world[own])
    alone = motion(positions[:40], headings(SECONDS[:40]), SECONDS[:40])
    np.testing.assert_array_equal(result[:40], smoothed(alone).object_to_world)


@pytest.mark.parametrize("interval", [0.01, 0.02, 1e-3, 1e-6])
def test_crowded_annotations_are_kept_or_smoothed_soundly(interval):
    times = np.sort(np.concatenate([SECONDS, [2.0 + interval, 2.0 + 2.0 * interval]]))
    given = motion(path(times), headings(times), times)
    result = smoothed(given)
    assert error(result, path(times)) < 0.005
    if interval < MIN_INTERVAL:
        np.testing.assert_array_equal(result.object_to_world, given.object_to_world)


def test_the_spline_is_the_most_probable_motion():
    """No small change lowers the sum of squares that it minimises, where no residual is an outlier."""
    random = np.random.default_rng(3)
    times = np.cumsum(random.uniform(0.05, 0.2, 30))
    given = random.normal(0.0, 0.02, (30, 1))
    weights = np.clip(np.gradient(times) / 0.3, None, 1.0) / POSITION_ERROR**2

    def cost(values: np.ndarray) -> float:
        jerks = [6.0 * _divided(times[i : i + 4], values[i : i + 4]) for i in range(27)]
        spans = (times[3:] - times[:-3]) / 3.0
        return float((weights * (values - given[:, 0]) ** 2).sum() + (spans * np.square(jerks)).sum() / JERK[0] ** 2)

    best = smooth(times, given, POSITION_ERROR, JERK[:1])[:, 0]
    for _ in range(20):
        assert cost(best + random.normal(0.0, 1e-3, 30)) > cost(best)


def _divided(times: np.ndarray, values: np.ndarray) -> float:
    """The divided difference, by its recursion."""
    if len(times) == 1:
        return float(values[0])
    return (_divided(times[1:], values[1:]) - _divided(times[:-1], values[:-1])) / (times[-1] - times[0])
