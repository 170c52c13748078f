"""Replayed and reacting traffic on straight paths."""

import math

import numpy as np
import pytest
from helpers.hand_made import about_z

from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import rigid
from drivesplat.settings.simulate import TrafficSettings
from drivesplat.simulate.traffic import MotionTables, MovingBox, Traffic
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import Motion

STEP = 0.1
CAR, MAN = np.array([4.0, 2.0, 1.5]), np.array([0.6, 0.6, 1.8])
FAR = MovingBox(np.array([0.0, 500.0]), 0.0, 0.0, 4.0, 2.0)


def moving(id: str, x: float, y: float, speed: float, size=CAR, kind=ObjectClass.CAR, heading=0.0, last=10.0):
    """An object that drives straight on for `last` seconds."""
    times = np.linspace(0.0, last, 11)
    along = np.array([math.cos(heading), math.sin(heading), 0.0])
    places = np.array([x, y, size[2] / 2]) + speed * times[:, None] * along
    motion = Motion(times, rigid(np.tile(about_z(heading), (11, 1, 1)), places), ((0, 10),), 0.25)
    return EditedActor.recorded(id, kind, "it", size, motion)


def standing_at(x: float, y: float = 0.0, speed: float = 0.0, yaw: float = 0.0) -> MovingBox:
    return MovingBox(np.array([x, y]), yaw, speed, 4.0, 2.0)


def traffic_of(*actors, seed=0, **settings) -> Traffic:
    made = TrafficSettings.model_validate(settings)
    return Traffic(actors, len(actors), made, 0.0, 60.0, np.random.default_rng(seed))


def played(traffic: Traffic, ego, steps: int) -> np.ndarray:
    """The places (steps, a, 2) after each step. `ego` is a box, or gives one for a step."""
    found = []
    for number in range(steps):
        traffic.advance(number * STEP, STEP, ego(number) if callable(ego) else ego)
        found.append(traffic.poses[:, :2, 3].copy())
    return np.array(found)


def test_replay_is_the_recorded_motion_whatever_is_in_the_way():
    car = moving("car", 0.0, 0.0, 8.0)
    traffic = traffic_of(car, vehicles="replay")
    found = played(traffic, standing_at(20.0), 50)
    np.testing.assert_allclose(found[:, 0, 0], 8.0 * STEP * np.arange(1, 51), atol=1e-9)
    assert traffic.as_recorded and traffic.speeds == pytest.approx([8.0])
    np.testing.assert_allclose(traffic.poses[0], car.poses(np.array([5.0]))[0], atol=1e-9)


def test_free_drivers_drive_exactly_as_recorded():
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0), moving("behind", -9.0, 0.0, 8.0))
    found = played(traffic, FAR, 60)
    np.testing.assert_allclose(found[:, 0, 0], 8.0 * STEP * np.arange(1, 61), atol=1e-9)
    assert traffic.as_recorded, "a recorded queue keeps its recorded gaps"


@pytest.mark.parametrize("distance", [35.0, 50.0])
def test_a_driver_stops_before_a_standing_ego_vehicle_at_his_gap(distance):
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0, last=40.0))
    found = played(traffic, standing_at(distance), 250)
    gap = distance - 4.0 - found[-1, 0, 0]
    assert 1.0 < gap < 4.0 and traffic.speeds[0] < 0.3 and not traffic.as_recorded
    assert (np.diff(found[:, 0, 0]) > -1e-9).all(), "nobody drives back"
    braking = -np.diff(found[:, 0, 0], n=2) / STEP**2
    assert braking[5:].max() < 5.0


def test_a_driver_goes_on_without_a_jump_when_the_way_is_free_again():
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0, last=60.0))
    found = played(traffic, lambda n: standing_at(30.0) if n < 120 else FAR, 300)[:, 0, 0]
    assert found[119] < 28.0 < found[-1]
    steps = np.diff(np.concatenate([[0.0], found]))
    assert (steps >= -1e-9).all() and steps.max() < 8.0 * STEP + 0.02
    assert steps[-1] / STEP == pytest.approx(8.0, abs=0.5)


def test_who_follows_the_one_that_braked_brakes_too():
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0, last=40.0), moving("behind", -12.0, 0.0, 8.0, last=40.0))
    played(traffic, standing_at(40.0), 250)
    ahead, behind = traffic.poses[:, 0, 3]
    assert 4.0 + 1.0 < ahead - behind < 4.0 + 5.0 and (traffic.speeds < 0.3).all()


@pytest.mark.parametrize(
    ("ego", "reacts"),
    [
        (standing_at(20.0, 3.0), False),  # in the next lane
        (standing_at(20.0, 2.1), True),  # its side reaches into the corridor
        (standing_at(-10.0), False),  # behind
        (standing_at(40.0, 0.0, 8.0), False),  # drives ahead as fast
        (standing_at(30.0, 0.0, 8.0, math.pi), True),  # comes towards it
        (standing_at(22.0, 3.0, 0.0, math.pi / 2), True),  # stands across its lane
    ],
)
def test_only_what_is_in_the_way_and_slower_makes_a_driver_brake(ego, reacts):
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0))
    played(traffic, ego, 5)
    assert traffic.as_recorded != reacts


def test_people_go_on_or_wait_until_the_vehicle_has_passed():
    def passing(number: int) -> MovingBox:
        return standing_at(-20.0 + 8.0 * STEP * number, -3.0, 8.0)

    man = moving("man", 0.0, -6.0, 1.2, MAN, ObjectClass.PEDESTRIAN, math.pi / 2, last=20.0)
    goes, waits = traffic_of(man), traffic_of(man, people="stop")
    went, waited = played(goes, passing, 100)[:, 0, 1], played(waits, passing, 100)[:, 0, 1]
    np.testing.assert_allclose(went, -6.0 + 1.2 * STEP * np.arange(1, 101), atol=1e-9)
    assert waited.max() < went.max() and np.isclose(np.diff(waited), 0.0, atol=1e-12).sum() > 5
    assert waited[-1] > waited[40], "he goes on afterwards"


def test_objects_are_there_as_long_as_their_own_clock_is_within_their_track():
    traffic = traffic_of(moving("car", 0.0, 0.0, 8.0, last=3.0), moving("late", 0.0, 50.0, 1.0))
    there = []
    for number in range(40):
        traffic.advance(number * STEP, STEP, FAR)
        there.append(traffic.present.copy())
    assert there[30][0] and not there[35][0] and all(found[1] for found in there)
    assert set(traffic.placements()) == {"late"}


def test_a_placement_has_the_pose_the_velocity_and_the_walked_length_of_the_own_clock():
    car = moving("car", 0.0, 0.0, 8.0)
    traffic = traffic_of(car)
    played(traffic, FAR, 20)
    placement = traffic.placements()["car"]
    np.testing.assert_allclose(placement.object_to_world, car.poses(np.array([2.0]))[0], atol=1e-9)
    before, after = (pose[0, 3] for pose in placement.around)
    assert (after - before) / 0.04 == pytest.approx(8.0, rel=1e-3)
    assert placement.walked == pytest.approx(float(car.walked(np.array([2.0]))[0]), abs=1e-6)


def test_drivers_vary_by_the_seed_alone():
    def gaps(seed: int) -> np.ndarray:
        traffic = traffic_of(moving("car", 0.0, 0.0, 8.0, last=40.0), seed=seed, variation=0.3)
        return played(traffic, standing_at(40.0), 60)

    np.testing.assert_array_equal(gaps(1), gaps(1))
    assert np.abs(gaps(1) - gaps(2)).max() > 0.05


def test_what_stands_at_the_end_of_the_recording_stays_there_and_what_drives_is_gone():
    stands, drives = moving("stands", 5.0, 3.0, 0.0), moving("drives", 0.0, 0.0, 8.0)
    made = TrafficSettings(vehicles="replay")
    traffic = Traffic([stands, drives], 2, made, 0.0, 9.5, np.random.default_rng(0))
    played(traffic, FAR, 200)
    assert traffic.present.tolist() == [True, False]
    np.testing.assert_allclose(traffic.poses[0], stands.poses(np.array([5.0]))[0], atol=1e-6)


def test_no_draw_leaves_a_driver_without_time_gap_or_acceleration():
    class Low(np.random.Generator):
        def standard_normal(self, shape):
            return np.full(shape, -2.0)

    car = moving("car", 0.0, 0.0, 8.0, last=40.0)
    traffic = Traffic([car], 1, TrafficSettings(variation=0.5), 0.0, 40.0, Low(np.random.PCG64(0)))
    found = played(traffic, standing_at(40.0), 100)
    assert np.isfinite(found).all() and found[-1, 0, 0] < 37.0


def test_a_car_that_accelerates_as_recorded_is_replayed():
    times = np.linspace(0.0, 10.0, 11)
    places = np.column_stack([0.5 * 1.5 * times**2, np.zeros(11), np.full(11, 0.75)])
    motion = Motion(times, rigid(np.tile(np.eye(3), (11, 1, 1)), places), ((0, 10),), 0.25)
    traffic = traffic_of(EditedActor.recorded("car", ObjectClass.CAR, "it", CAR, motion))
    played(traffic, FAR, 80)
    assert traffic.as_recorded


def test_no_objects_are_no_fault():
    traffic = traffic_of()
    assert played(traffic, FAR, 3).shape == (3, 0, 2) and traffic.placements() == {}


def test_tables_turn_the_short_way_round():
    turning = moving("car", 0.0, 0.0, 1.0)
    motion = turning.path.trajectory.motion
    headings = np.linspace(3.0, 3.4, 11)  # through pi
    turned = Motion(motion.times, rigid(np.stack([about_z(a) for a in headings]), motion.object_to_world[:, :3, 3]),
                    motion.runs, motion.reach)  # fmt: skip
    actor = EditedActor.recorded("car", ObjectClass.CAR, "it", CAR, turned)
    tables = MotionTables.of([actor], 0.0, 10.0)
    for time in np.linspace(0.1, 9.9, 37):
        np.testing.assert_allclose(tables.poses(np.array([time]))[0], actor.poses(np.array([time]))[0], atol=2e-4)
