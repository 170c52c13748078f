"""Accelerations and turning of paths in closed form."""

import numpy as np
import pytest
from helpers.driven_runs import circle, poses, straight, times

from drivesplat.simulate.comfort import ACCELERATION, BOUNDS, JERK, YAW_RATE, comfort_columns, comfort_extremes


def columns_of(run) -> dict[str, np.ndarray]:
    return comfort_columns(run.seconds, run.ego_to_world, run.speed)


def along_x(seconds: np.ndarray, speed: np.ndarray) -> dict[str, np.ndarray]:
    """Straight at speeds (n,); what is beside the speed does not depend on the place."""
    return comfort_columns(seconds, poses(np.zeros(len(seconds)), 0.0, 0.0), speed)


def assert_close(values: np.ndarray, expected, least: int = 1, atol: float = 1e-6) -> None:
    """Within 1 % where known, and known at `least` so many steps."""
    known = ~np.isnan(values)
    assert known.sum() >= least
    np.testing.assert_allclose(values[known], np.broadcast_to(expected, len(values))[known], rtol=0.01, atol=atol)


def test_constant_speed_has_no_acceleration():
    columns = columns_of(straight(5.0, 12.0))
    for name in BOUNDS:
        assert_close(columns[name], 0.0, least=20)
    assert (columns["comfortable"][4:-4] == 1.0).all()


@pytest.mark.parametrize(("acceleration", "comfortable"), [(2.3, True), (2.5, False), (-4.0, True), (-4.1, False)])
def test_constant_acceleration_and_its_bounds(acceleration, comfortable):
    seconds = times(4.0)
    columns = along_x(seconds, 20.0 + acceleration * seconds)
    assert_close(columns["lon_acceleration"], acceleration, least=30)
    assert_close(columns["jerk"], 0.0)
    assert columns["comfortable"][20] == comfortable
    assert comfort_extremes(columns)["lon_acceleration"]["within"] == comfortable


@pytest.mark.parametrize(("jerk", "within"), [(4.0, (True, True)), (4.2, (False, True)), (8.5, (False, False))])
def test_constant_jerk_and_its_bounds(jerk, within):
    seconds = times(4.0)
    columns = along_x(seconds, 30.0 + 0.5 * jerk * (seconds - 2.0) ** 2)
    assert_close(columns["lon_jerk"], jerk, least=15)
    assert_close(columns["jerk"], jerk, least=15)
    assert_close(columns["lon_acceleration"], jerk * (seconds - 2.0))
    extremes = comfort_extremes(columns)
    assert (extremes["lon_jerk"]["within"], extremes["jerk"]["within"]) == within


@pytest.mark.parametrize("speed", [8.0, -3.0])
def test_a_circle_has_the_lateral_acceleration_of_its_radius(speed):
    radius = 20.0
    columns = columns_of(circle(6.0, speed, radius))
    assert_close(columns["lat_acceleration"], speed**2 / radius, least=50)
    assert_close(columns["yaw_rate"], speed / radius, least=50)
    assert_close(columns["yaw_acceleration"], 0.0, atol=1e-6)
    assert_close(columns["jerk"], 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("excess", "within"), [(0.99, True), (1.01, False)])
def test_bounds_of_turning(sign, excess, within):
    """A circle with a lateral acceleration of 4.89 m/s², one with a yaw rate of 0.95 rad/s, and a clothoid with a yaw
    acceleration of 1.93 rad/s²; each by a little less or more."""
    seconds = times(2.0)
    for name, speed, yaw in (
        ("lat_acceleration", 20.0, 4.89 / 20.0 * seconds), ("yaw_rate", 2.0, 0.95 * seconds),
        ("yaw_acceleration", 0.5, 0.5 * 1.93 * (seconds - 1.0) ** 2),
    ):  # fmt: skip
        columns = comfort_columns(seconds, poses(0.0 * seconds, 0.0, sign * excess * yaw), np.full(21, speed))
        assert comfort_extremes(columns)[name]["within"] == within, name
        if name != "yaw_acceleration":  # at whose ends the yaw rate is large, too
            assert (np.nanmin(columns["comfortable"]) == 1.0) == within, name


def test_headings_beyond_half_a_turn_are_continued():
    columns = columns_of(circle(15.0, 10.0, 15.0))  # 1.6 laps
    assert_close(columns["yaw_rate"], 10.0 / 15.0, least=140)


def test_a_growing_curvature_has_a_lateral_jerk():
    seconds, speed, rate = times(5.0), 10.0, 0.05  # a clothoid: the heading grows with the square of time
    columns = comfort_columns(seconds, poses(0.0 * seconds, 0.0, 0.5 * rate * seconds**2), np.full(51, speed))
    assert_close(columns["yaw_acceleration"], rate, least=40)
    assert_close(columns["lat_acceleration"], speed * rate * seconds, least=40)
    assert_close(columns["jerk"], speed * rate, least=29)
    assert_close(columns["lon_jerk"], 0.0)


def test_a_lane_change_and_a_swerve():
    speed, seconds = 15.0, times(10.0, 0.05)
    for amplitude, period, comfortable in ((0.05, 5.0, True), (0.4, 5.0, False)):
        turn = 2.0 * np.pi / period
        columns = comfort_columns(
            seconds, poses(0.0 * seconds, 0.0, amplitude * np.sin(turn * seconds)), np.full(len(seconds), speed)
        )
        expected = speed * amplitude * turn * np.cos(turn * seconds)
        assert_close(columns["lat_acceleration"], expected, least=150, atol=0.01 * np.abs(expected).max())
        assert (np.nanmin(columns["comfortable"]) == 1.0) == comfortable
        assert comfort_extremes(columns)["lat_acceleration"]["within"] == (speed * amplitude * turn < 4.89)


def test_times_need_not_be_even():
    rng = np.random.default_rng(1)
    seconds = np.cumsum(rng.uniform(0.05, 0.15, 60))
    columns = along_x(seconds, 5.0 + 1.5 * seconds)
    assert_close(columns["lon_acceleration"], 1.5, least=40)
    assert_close(columns["jerk"], 0.0)


@pytest.mark.parametrize(("dt", "windows"), [(0.1, (9, 15, 5)), (0.05, (17, 29, 9)), (0.5, (5, 3, 3))])
def test_windows_last_as_long_at_any_rate(dt, windows):
    seconds = times(20.0, dt)
    assert tuple(one.window(seconds) for one in (ACCELERATION, JERK, YAW_RATE)) == windows


@pytest.mark.parametrize(("steps", "known"), [(1, 0), (2, 0), (3, 0), (4, 0), (5, 1), (7, 1), (8, 2), (20, 12)])
def test_short_runs_have_shorter_windows_or_no_value(steps, known):
    columns = along_x(np.arange(steps) * 0.1, 5.0 + 0.1 * np.arange(steps))
    assert_close(columns["lon_acceleration"], 1.0, least=known)
    assert (~np.isnan(columns["lon_acceleration"])).sum() == known
    assert (comfort_extremes(columns)["lon_acceleration"]["within"] is None) == (known == 0)
    assert np.isnan(columns["comfortable"]).all() == (steps < 3)  # three steps have a yaw rate
