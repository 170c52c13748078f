"""Contacts, whose fault they are, and the time to them, compared with closed forms."""

import numpy as np
import pytest
from helpers.driven_runs import car, driven, poses, straight, times

from drivesplat.scene.object_class import ObjectClass
from drivesplat.simulate.contacts import ContactKind
from drivesplat.simulate.driven_run import DrivenRun
from drivesplat.simulate.scores import RunScores, run_scores

FRONT, REAR = 3.7, 0.9
"""Metres from the rear axle to the ends of the ego vehicle; the car's half length is 2."""


def only_contact(scores: RunScores):
    assert len(scores.contacts) == 1
    return scores.contacts[0]


def with_car(run: DrivenRun, x, y, yaw=0.0, **changes) -> RunScores:
    """The scores of a run with one more car."""
    other = car(run.seconds, x, y, yaw, **changes)
    return run_scores(
        driven(run.seconds, run.ego_to_world, run.speed, [other], run.recorded, run.drivable, run.loop_from)
    )


def test_hitting_a_standing_car_is_at_fault():
    scores = with_car(straight(6.0, 10.0), 50.0, 0.5)
    contact, second = only_contact(scores), (50.0 - 2.0 - FRONT) / 10.0
    assert contact.kind is ContactKind.STOPPED_OBJECT and contact.at_fault and contact.side == "front"
    assert contact.first_step == np.ceil(second / 0.1) and contact.second == pytest.approx(4.5)
    assert contact.relative_speed == pytest.approx(10.0)
    incident = {"kind": "collision_front", "step": 45, "object": "car", "at_fault": True, "second": pytest.approx(4.5)}
    assert scores.summary["first_incident"] == incident
    assert scores.summary["nc"] == 0.0 and scores.summary["alpasim_score"] == 0.0 and scores.summary["pdms"] == 0.0
    touching = {name: np.flatnonzero(scores.columns[f"collision_{name}"]) for name in ("any", "front", "rear")}
    np.testing.assert_array_equal(touching["any"], np.arange(45, 53))  # until its rear is 2 m beyond the middle
    np.testing.assert_array_equal(touching["front"], np.arange(45, 49))
    np.testing.assert_array_equal(touching["rear"], np.arange(49, 53))
    assert scores.summary["collision_front"] and not scores.summary["collision_rear"]


def test_hitting_a_static_thing_costs_half():
    scores = with_car(straight(6.0, 10.0), 50.0, 0.0, object_class=ObjectClass.OTHER_MOVABLE)
    assert scores.summary["nc"] == 0.5 and scores.summary["at_fault_collisions"] == 1


def test_the_time_to_collision_with_a_car_that_comes_head_on():
    run = straight(5.0, 10.0)
    scores = with_car(run, 100.0 - 8.0 * run.seconds, 0.0, np.pi)
    expected = (100.0 - 2.0 - FRONT) / 18.0 - run.seconds
    before = run.seconds < expected[0]
    times_left = np.where(expected <= 5.0, expected, np.inf)
    np.testing.assert_allclose(scores.columns["ttc_s"][before], times_left[before], rtol=0.01, atol=1e-6)
    np.testing.assert_array_equal(scores.columns["ttc_ok"], (expected > 1.0).astype(float))
    assert np.isinf(scores.columns["ttc_s"][0]) and scores.summary["ttc"] == 0.0


@pytest.mark.parametrize("horizon", [1.0, 2.5])
def test_the_horizon_of_the_time_to_collision_is_a_parameter(horizon):
    run = straight(3.0, 10.0)
    run = driven(run.seconds, run.ego_to_world, run.speed, [car(run.seconds, 40.0, 0.0)])
    scores, left = run_scores(run, ttc_horizon=horizon, ttc_max=2.0), (40.0 - 2.0 - FRONT) / 10.0 - run.seconds
    np.testing.assert_array_equal(scores.columns["ttc_ok"], (left > horizon).astype(float))
    np.testing.assert_allclose(scores.columns["ttc_s"], np.where(left <= 2.0, left, np.inf), atol=1e-9)


def test_following_and_overtaking_touch_nothing():
    run = straight(8.0, 15.0)
    scores = with_car(run, 30.0 + 10.0 * run.seconds, 3.0)
    assert not scores.contacts and scores.summary["nc"] == scores.summary["ttc"] == 1.0
    assert scores.summary["min_ttc_s"] is None and np.isinf(scores.columns["ttc_s"]).all()
    slower = with_car(run, 30.0 + 15.0 * run.seconds, 0.0)
    assert np.isinf(slower.columns["ttc_s"]).all()
    closing, left = with_car(run, 14.0 + 13.0 * run.seconds, 0.0), (14.0 - 2.0 - FRONT) / 2.0 - run.seconds
    np.testing.assert_allclose(closing.columns["ttc_s"][:41], left[:41], rtol=0.01, atol=1e-6)


def test_being_hit_from_behind_is_not_at_fault():
    run = straight(6.0, 5.0)
    scores = with_car(run, -40.0 + 15.0 * run.seconds, 0.0)
    contact, second = only_contact(scores), (40.0 - 2.0 - REAR) / 10.0
    assert contact.kind is ContactKind.REAR and not contact.at_fault and contact.side == "rear"
    assert contact.second == pytest.approx(np.ceil(second / 0.1) * 0.1)
    assert contact.relative_speed == pytest.approx(10.0)
    assert scores.summary["nc"] == scores.summary["ttc"] == 1.0 and scores.summary["at_fault_collisions"] == 0
    assert scores.summary["collision_rear"] and not scores.summary["collision_at_fault"]
    assert scores.columns["ttc_s"][20] == pytest.approx(second - 2.0, rel=0.01)


def test_a_standing_ego_vehicle_is_not_at_fault():
    run = straight(6.0, 0.0)
    scores = with_car(run, 40.0 - 10.0 * run.seconds, 0.0, np.pi)
    contact = only_contact(scores)
    assert contact.kind is ContactKind.STOPPED_EGO and not contact.at_fault and contact.side == "front"
    assert scores.summary["nc"] == scores.summary["ttc"] == 1.0
    assert scores.summary["collision_at_fault"]  # AlpaSim's rule asks for the end alone


@pytest.mark.parametrize(("speed", "score"), [(0.004, 1.0), (0.006, 0.0)])
def test_an_ego_vehicle_that_creeps_threatens_others(speed, score):
    run = straight(2.5, speed)
    scores = with_car(run, 20.0 - 5.0 * run.seconds, 0.0, np.pi)  # touches after 2.9 s
    assert not scores.contacts and scores.columns["ttc_s"][-1] == pytest.approx(0.36, rel=0.01)
    assert scores.summary["ttc"] == scores.columns["ttc_ok"][-1] == score


def test_reversing_swaps_front_and_rear():
    run = straight(6.0, -5.0)
    ahead = with_car(run, 40.0 - 15.0 * run.seconds, 0.0, np.pi)
    assert only_contact(ahead).kind is ContactKind.REAR and only_contact(ahead).side == "front"
    behind = with_car(run, -40.0 + 5.0 * run.seconds, 0.0)
    assert only_contact(behind).kind is ContactKind.FRONT and only_contact(behind).at_fault
    assert only_contact(behind).side == "rear" and only_contact(behind).relative_speed == pytest.approx(10.0)
    left = (40.0 - 2.0 - REAR) / 10.0 - run.seconds
    before = left > 0.05
    np.testing.assert_array_equal(behind.columns["ttc_ok"][before], (left > 1.0).astype(float)[before])


def test_what_is_behind_is_seen_from_the_trailing_axle():
    """A car closes up from 5 m and touches a corner: from that axle it is 2.9 m behind and 1.9 m beside, 147 degrees.
    From the other axle it would be 161 degrees, and so behind."""
    reversing = with_car(straight(4.0, -5.0), 10.7 - 7.5 * times(4.0), 1.9, np.pi)
    forward = with_car(straight(4.0, 5.0), 2.8 - 10.7 + 7.5 * times(4.0), 1.9)
    for scores in (reversing, forward):
        assert only_contact(scores).first_step == 20 and only_contact(scores).kind is ContactKind.LATERAL


@pytest.mark.parametrize(
    ("ego", "other", "kind"),
    [
        (0.04, 5.0, ContactKind.STOPPED_EGO), (0.06, 5.0, ContactKind.FRONT),
        (5.0, 0.04, ContactKind.STOPPED_OBJECT), (5.0, 0.06, ContactKind.FRONT),
    ],
)  # fmt: skip
def test_vehicles_up_to_5_cm_per_second_count_as_stopped(ego, other, kind):
    run = straight(3.0, ego)
    assert only_contact(with_car(run, 12.0 - other * run.seconds, 0.0, np.pi)).kind is kind


@pytest.mark.parametrize(("offset", "at_fault"), [(0.0, False), (1.0, True)])
def test_contact_at_the_side_is_at_fault_outside_of_the_own_lane(offset, at_fault):
    """A car beside the ego vehicle drifts into it. Of half a lane of 1.75 m, half the width takes 0.95 m."""
    run = straight(4.0, 10.0)
    own = driven(run.seconds, poses(10.0 * run.seconds, offset, 0.0), 10.0, recorded=run.ego_to_world)
    scores = with_car(own, 10.0 * run.seconds + 1.4, offset + 4.0 - run.seconds)
    contact, second = only_contact(scores), 4.0 - 1.0 - 0.95
    assert contact.kind is ContactKind.LATERAL and contact.side == "lateral" and contact.at_fault == at_fault
    assert contact.second == pytest.approx(np.ceil(second / 0.1) * 0.1) and contact.relative_speed == pytest.approx(1.0)
    assert scores.summary["collision_lateral"] and scores.summary["nc"] == (0.0 if at_fault else 1.0)
    before = run.seconds < second
    np.testing.assert_allclose(scores.columns["ttc_s"][before], (second - run.seconds)[before], atol=1e-6)
    expected = (second - run.seconds <= 1.0) if at_fault else np.zeros(len(run), dtype=bool)
    np.testing.assert_array_equal(scores.columns["ttc_ok"] == 0.0, expected)


def test_contact_at_the_side_is_at_fault_off_the_drivable_area():
    run = straight(4.0, 10.0)
    own = driven(run.seconds, run.ego_to_world, 10.0, drivable=lambda places: (places[:, 0] < 5.0) | (places[:, 1] > 0))
    scores = with_car(own, 10.0 * run.seconds + 1.4, 4.0 - run.seconds)
    assert only_contact(scores).kind is ContactKind.LATERAL and only_contact(scores).at_fault


def test_objects_that_appear_and_vanish():
    run = straight(6.0, 10.0)
    there = (run.seconds > 1.95) & (run.seconds < 3.95)  # it is gone 0.5 m before the ego vehicle reaches it
    scores = with_car(run, 46.0, 0.0, present=there)
    assert not scores.contacts
    left = (46.0 - 2.0 - FRONT) / 10.0 - run.seconds
    np.testing.assert_allclose(scores.columns["ttc_s"], np.where(there, left, np.inf), atol=1e-9)
    longer = with_car(run, 46.0, 0.0, present=run.seconds > 1.95)
    assert only_contact(longer).first_step == 41


def test_poses_of_absent_steps_mean_nothing():
    run = straight(3.0, 10.0)
    other = car(run.seconds, 20.0, 0.0, present=run.seconds < 0.55)
    other.object_to_world[6:] = np.nan
    scores = run_scores(driven(run.seconds, run.ego_to_world, 10.0, [other]))
    assert not scores.contacts and np.isinf(scores.columns["ttc_s"][6:]).all()
    assert scores.columns["ttc_s"][0] == pytest.approx((20.0 - 2.0 - FRONT) / 10.0)


def test_a_bridge_above_the_road_is_not_hit():
    run = straight(6.0, 10.0)
    above = np.array(poses(np.full(len(run), 30.0), 0.0, 0.0, 5.5))
    scores = with_car(run, 30.0, 0.0, size=np.array([8.0, 20.0, 1.0]), object_to_world=above)
    assert not scores.contacts and scores.summary["min_ttc_s"] is None
    lower = np.array(poses(np.full(len(run), 30.0), 0.0, 0.0, 2.0))
    assert with_car(run, 30.0, 0.0, size=np.array([8.0, 20.0, 1.0]), object_to_world=lower).contacts


def test_on_a_ramp_heights_change_along_the_way():
    """A car that stands 60 m further up, and so 5.8 m higher."""
    seconds, pitch = times(6.0), np.arctan(0.1)
    forward = np.array([np.cos(pitch), 0.0, np.sin(pitch)])
    own = poses(0.0 * seconds, 0.0, 0.0)
    own[:, :3, :3] = np.stack([forward, [0.0, 1.0, 0.0], [-forward[2], 0.0, forward[0]]], axis=-1)
    standing = own.copy()
    standing[:, :3, 3] = 60.0 * forward + 0.75 * own[0, :3, 2]
    own[:, :3, 3] = 10.0 * seconds[:, None] * forward
    scores = run_scores(driven(seconds, own, 10.0, [car(seconds, 0.0, 0.0, object_to_world=standing)]))
    left = (60.0 - 2.0 - FRONT) / 10.0 - seconds
    before = (left > 0.05) & (left < 4.9)
    np.testing.assert_allclose(scores.columns["ttc_s"][before], left[before], rtol=0.01, atol=0.01)
    assert only_contact(scores).at_fault


def test_a_contact_that_the_loop_begins_with_is_reported_and_does_not_count():
    run = straight(6.0, 10.0)
    late = driven(run.seconds, run.ego_to_world, 10.0, loop_from=20)
    scores = with_car(late, 20.0 + 2.0, 0.0)
    contact = only_contact(scores)
    assert not contact.counts and contact.first_step == 20 and contact.second == pytest.approx(2.0)
    assert scores.summary["contacts"][0]["counts"] is False and scores.summary["contacts"][0]["first_step"] == 20
    assert scores.summary["collisions"] == 0 and scores.summary["nc"] == scores.summary["ttc"] == 1.0
    assert scores.summary["first_incident"] is None and not scores.summary["collision_any"]
    assert np.isinf(scores.columns["ttc_s"][20:]).all() and np.nansum(scores.columns["collision_front"]) == 0.0


def test_contacts_before_the_loop_are_unknown():
    run = straight(6.0, 10.0)
    late = driven(run.seconds, run.ego_to_world, 10.0, loop_from=40)
    scores = with_car(late, 15.0, 0.0)
    assert not scores.contacts and scores.summary["collisions"] == 0
    assert np.isnan(scores.columns["collision_any"][:40]).all() and (scores.columns["collision_any"][40:] == 0.0).all()


def test_a_contact_that_flickers_is_one_and_a_later_one_another():
    seconds = times(10.0)
    there = np.ones(len(seconds), dtype=bool)
    there[[30, 33, 34]] = False
    there[50:70] = False
    scores = run_scores(driven(seconds, poses(0.0 * seconds, 0.0, 0.0), 0.0, [car(seconds, 4.0, 0.0, present=there)]))
    assert [(c.first_step, c.last_step, c.counts) for c in scores.contacts] == [(0, 49, False), (70, 100, True)]


@pytest.mark.parametrize("order", [1, -1])
def test_each_object_has_its_own_contact_and_all_sides_are_reported(order):
    """AlpaSim keeps the side of the last object alone."""
    run = straight(3.0, 10.0)
    others = [
        car(run.seconds, 32.0, 0.0, id="ahead"),
        car(run.seconds, 10.0 * run.seconds + 1.4, 4.4 - run.seconds, id="beside"),
    ]
    scores = run_scores(driven(run.seconds, run.ego_to_world, 10.0, others[::order]))
    assert [(c.object_id, c.first_step, c.side) for c in scores.contacts] == [
        ("beside", 25, "lateral"), ("ahead", 27, "front"),
    ]  # fmt: skip
    assert scores.columns["collision_front"][28] == scores.columns["collision_lateral"][28] == 1.0
    assert scores.summary["collisions"] == 2 and scores.summary["at_fault_collisions"] == 1
