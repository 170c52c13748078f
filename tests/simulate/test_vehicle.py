"""How the ego vehicle moves: against closed forms."""

import math

import numpy as np
import pytest
from helpers.hand_made import about_z
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesplat.errors import RequestError
from drivesplat.scene.rigid import rigid
from drivesplat.settings.simulate import VehicleSettings
from drivesplat.simulate.vehicle import RecordedGround, VehicleState, advanced, control_towards, shape_of, state_of

LIMITS = VehicleSettings(max_steering_rate=20.0)
STEP = 0.1


def driven(state: VehicleState, steering: float, acceleration: float, steps: int, limits=LIMITS) -> list[VehicleState]:
    states = [state]
    for _ in range(steps):
        states.append(advanced(states[-1], steering, acceleration, STEP, limits))
    return states


def test_straight_ahead_it_moves_as_far_as_its_mean_speed_takes_it():
    last = driven(VehicleState(1.0, 2.0, 0.5, 10.0), 0.0, 2.0, 20)[-1]
    far = 10.0 * 2.0 + 0.5 * 2.0 * 2.0**2
    np.testing.assert_allclose([last.x, last.y], [1 + far * math.cos(0.5), 2 + far * math.sin(0.5)], atol=1e-9)
    assert last.speed == pytest.approx(14.0) and last.acceleration == pytest.approx(2.0) and last.yaw == 0.5


@pytest.mark.parametrize("angle", [0.1, -0.3])
def test_with_turned_wheels_its_rear_axle_drives_on_a_circle(angle):
    start = VehicleState(0.0, 0.0, 0.0, 8.0, angle)
    radius = LIMITS.wheelbase / math.tan(angle)
    for state in driven(start, angle, 0.0, 60):
        assert math.hypot(state.x, state.y - radius) == pytest.approx(abs(radius), rel=1e-5)
        assert state.yaw_rate(LIMITS.wheelbase) == pytest.approx(8.0 / radius)
    assert driven(start, angle, 0.0, 60)[-1].yaw == pytest.approx(8.0 * 6.0 / radius)


def test_it_stops_where_braking_takes_it_and_stays_there():
    states = driven(VehicleState(0.0, 0.0, 0.0, 9.9), 0.0, -4.0, 40)
    assert states[-1].speed == 0.0 and states[-1].x == pytest.approx(9.9**2 / 8.0, abs=0.02)
    assert all(state.speed >= 0.0 for state in states) and states[-1].x == states[-2].x


def test_backwards_only_as_fast_as_it_may():
    back = LIMITS.model_copy(update={"max_reverse_speed": 1.5})
    last = driven(VehicleState(0.0, 0.0, 0.0, 0.0), 0.0, -2.0, 30, back)[-1]
    assert last.speed == -1.5 and last.x < -3.0


def test_inputs_beyond_its_limits_are_clipped_and_wheels_turn_at_their_rate():
    slow = VehicleSettings(max_steering=0.5, max_steering_rate=0.8, max_acceleration=2.0)
    first, second = driven(VehicleState(0.0, 0.0, 0.0, 5.0), 9.0, 9.0, 2, slow)[1:]
    assert first.steering == pytest.approx(0.08) and second.steering == pytest.approx(0.16)
    assert first.acceleration == pytest.approx(2.0)
    assert driven(VehicleState(0.0, 0.0, 0.0, 5.0), 9.0, 0.0, 20, slow)[-1].steering == 0.5
    fast = slow.model_copy(update={"max_speed": 5.5})
    assert driven(VehicleState(0.0, 0.0, 0.0, 5.0), 0.0, 9.0, 20, fast)[-1].speed == 5.5


@settings(max_examples=25)
@given(st.floats(1.0, 15.0), st.floats(-0.05, 0.05), st.floats(-1.0, 1.0))
def test_the_controller_follows_poses_that_the_vehicle_can_drive(speed, angle, push):
    """It begins 0.5 m beside the targets, and ends on them."""
    start = VehicleState(0.0, 0.0, 0.0, speed, angle)
    wanted = driven(start, angle, push, 60)
    now = VehicleState(0.0, 0.5, 0.0, speed)
    for number in range(40):
        ahead = wanted[number + 1 : number + 11]
        local = now.in_frame(np.array([[state.x, state.y] for state in ahead]))
        targets = np.column_stack([local, [state.yaw - now.yaw for state in ahead]])
        now = advanced(now, *control_towards(now, targets, STEP, LIMITS), STEP, LIMITS)
    assert math.dist((now.x, now.y), (wanted[40].x, wanted[40].y)) < 0.6
    assert now.speed == pytest.approx(wanted[40].speed, abs=0.6)


def test_backwards_the_controller_steers_as_forwards():
    back = LIMITS.model_copy(update={"max_reverse_speed": 3.0})
    targets = np.column_stack([0.1 * np.arange(1, 6), np.full(5, 0.1), np.zeros(5)])
    ahead, _ = control_towards(VehicleState(0.0, 0.0, 0.0, 1.0), targets, STEP, back)
    behind, push = control_towards(VehicleState(0.0, 0.0, 0.0, -1.0), targets * [-1.0, 1.0, 1.0], STEP, back)
    assert ahead == pytest.approx(behind, rel=1e-6) and push == pytest.approx(0.0, abs=1e-6)


def test_the_controller_brakes_where_the_targets_stay_here():
    steering, acceleration = control_towards(VehicleState(0.0, 0.0, 0.0, 3.0, 0.1), np.zeros((5, 3)), STEP, LIMITS)
    assert (steering, acceleration) == (0.1, pytest.approx(-30.0))


def test_on_a_slope_the_vehicle_lies_in_the_plane_of_the_recorded_poses():
    climb = 0.1
    up = np.array([-climb, 0.0, 1.0]) / math.hypot(1.0, climb)
    forward = np.array([1.0, 0.0, climb]) / math.hypot(1.0, climb)
    turn = np.stack([forward, np.cross(up, forward), up], axis=1)
    places = np.array([[x, 0.0, climb * x] for x in np.linspace(0.0, 20.0, 41)])
    ground = RecordedGround(rigid(np.tile(turn, (41, 1, 1)), places))
    pose = ground.ego_to_world(VehicleState(10.1, 3.0, 0.7, 5.0))
    np.testing.assert_allclose(pose[:3, 3], [10.1, 3.0, 1.01], atol=1e-9)
    np.testing.assert_allclose(pose[:3, 2], up, atol=1e-9)
    assert math.atan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.7)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    with pytest.raises(RequestError, match="no ground to drive on"):
        RecordedGround(np.zeros((0, 4, 4)))


def test_a_state_has_the_place_the_heading_and_the_turning_wheels_of_a_pose():
    state = state_of(rigid(about_z(0.3), np.array([4.0, 5.0, 6.0])), 5.0, 0.2, LIMITS.wheelbase)
    assert (state.x, state.y, state.yaw) == pytest.approx((4.0, 5.0, 0.3))
    assert state.yaw_rate(LIMITS.wheelbase) == pytest.approx(0.2)
    assert state_of(np.eye(4), 0.1, 3.0, LIMITS.wheelbase).steering == 0.0, "a standing vehicle says nothing"


def test_the_body_reaches_as_far_ahead_as_its_length_leaves():
    shape = shape_of(VehicleSettings(length=5.0, rear_overhang=1.0))
    assert shape.centre == pytest.approx(1.5)
