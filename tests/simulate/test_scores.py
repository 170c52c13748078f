"""Scores of whole runs, compared with closed forms."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.driven_runs import car, circle, driven, moved, poses, straight, times
from hypothesis import given, settings
from hypothesis import strategies as st

from drivesplat.errors import RequestError
from drivesplat.simulate.driven_run import DrivenRun
from drivesplat.simulate.scores import RunScores, pdm_score, run_scores


def beside(offset: float, duration: float = 5.0, **changes) -> DrivenRun:
    """A run at 10 m/s, `offset` metres to the left of the recorded path."""
    seconds = times(duration)
    return driven(
        seconds, poses(10.0 * seconds, offset, 0.0), 10.0, recorded=poses(10.0 * seconds, 0.0, 0.0), **changes
    )


def test_driving_as_recorded_has_full_scores():
    run = straight(5.0, 10.0, drivable=lambda places: np.abs(places[:, 1]) < 3.0)
    summary = run_scores(run).summary
    assert {name: summary[name] for name in ("nc", "dac", "ttc", "ep", "c", "ddc")} == dict.fromkeys(
        ("nc", "dac", "ttc", "ep", "c", "ddc"), 1.0
    )
    assert summary["pdms"] == summary["hugsim_pdms"] == summary["alpasim_score"] == summary["rc"] == 1.0
    assert summary["duration_s"] == pytest.approx(5.0) and summary["distance_m"] == pytest.approx(50.0)
    assert summary["progress_m"] == pytest.approx(50.0) and summary["progress_ratio"] == pytest.approx(1.0)
    assert summary["ade_m"] == pytest.approx(0.0, abs=1e-9) and summary["not_known"] == []
    assert summary["first_incident"] is None


@pytest.mark.parametrize("offset", [1.5, -2.5])
def test_driving_beside_the_path(offset):
    scores = run_scores(beside(offset))
    np.testing.assert_allclose(scores.columns["path_offset_m"], offset, rtol=0.01)
    for name in ("dist_to_gt_trajectory", "dist_to_gt_location"):
        np.testing.assert_allclose(scores.columns[name], abs(offset), rtol=0.01)
    assert scores.summary["ade_m"] == pytest.approx(abs(offset), rel=0.01)
    assert scores.summary["progress_m"] == pytest.approx(50.0, rel=0.01)
    assert scores.summary["max_path_offset_m"] == pytest.approx(abs(offset), rel=0.01)


def test_driving_more_slowly_than_recorded():
    seconds = times(8.0)
    run = driven(seconds, poses(5.0 * seconds, 0.0, 0.0), 5.0, recorded=poses(10.0 * seconds, 0.0, 0.0))
    scores = run_scores(run)
    assert scores.summary["ep"] == scores.summary["progress_ratio"] == pytest.approx(0.5, rel=0.01)
    assert scores.summary["pdms"] == pytest.approx((5.0 + 2.5 + 2.0) / 12.0, rel=0.01)
    assert scores.summary["hugsim_pdms"] == 1.0
    assert scores.summary["rc"] == pytest.approx(0.5 / 0.9, rel=0.01)
    assert scores.summary["hd_score"] == pytest.approx(0.5 / 0.9, rel=0.01)
    assert scores.summary["hugsim_rc"] == pytest.approx(41 / (0.9 * 81))
    assert scores.summary["alpasim_score"] == pytest.approx(0.5 / 0.8, rel=0.01)
    np.testing.assert_allclose(scores.columns["dist_to_gt_location"], 5.0 * seconds, rtol=0.01, atol=1e-9)
    np.testing.assert_allclose(scores.columns["dist_to_gt_trajectory"], 0.0, atol=1e-9)
    assert scores.summary["ade_m"] == pytest.approx(20.0, rel=0.01)


def test_a_faster_ego_vehicle_goes_beyond_the_recorded_path():
    seconds = times(5.0)
    run = driven(seconds, poses(15.0 * seconds, 0.0, 0.0), 15.0, recorded=poses(10.0 * seconds, 0.0, 0.0))
    scores = run_scores(run)
    assert scores.summary["progress_m"] == pytest.approx(75.0, rel=0.01) and scores.summary["ep"] == 1.0
    assert scores.summary["progress_ratio"] == pytest.approx(1.5, rel=0.01) and scores.summary["rc"] == 1.0
    assert scores.columns["dist_to_gt_trajectory"][-1] == pytest.approx(25.0, rel=0.01)
    assert scores.columns["path_offset_m"][-1] == pytest.approx(0.0, abs=1e-9)
    assert not scores.summary["left_corridor_laterally"] and scores.summary["alpasim_steps"] == 37  # 54 m: 4 m beyond


def test_accelerating_and_braking_to_rest():
    seconds = times(6.0)
    speed = np.maximum(12.0 - 3.0 * seconds, 0.0)
    x = np.where(seconds < 4.0, 12.0 * seconds - 1.5 * seconds**2, 24.0)
    scores = run_scores(driven(seconds, poses(x, 0.0, 0.0), speed, recorded=poses(12.0 * seconds, 0.0, 0.0)))
    assert scores.summary["distance_m"] == pytest.approx(12.0**2 / (2 * 3.0), rel=0.01)
    np.testing.assert_allclose(scores.columns["progress_m"], x, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(scores.columns["lon_acceleration"][5:30], -3.0, rtol=0.01)
    assert scores.columns["lon_acceleration"][50] == pytest.approx(0.0, abs=1e-9)
    assert scores.summary["ep"] == pytest.approx(24.0 / 72.0, rel=0.01)
    x = 2.0 * seconds + 0.5 * 1.2 * seconds**2
    scores = run_scores(driven(seconds, poses(x, 0.0, 0.0), 2.0 + 1.2 * seconds))
    np.testing.assert_allclose(scores.columns["lon_acceleration"][10:50], 1.2, rtol=0.01)
    assert scores.summary["distance_m"] == pytest.approx(33.6, rel=0.01) and scores.summary["c"] == 1.0


def test_a_circle():
    scores = run_scores(circle(12.0, 8.0, 12.0))  # 1.3 laps
    assert scores.summary["progress_m"] == pytest.approx(96.0, rel=0.01)
    np.testing.assert_allclose(scores.columns["lat_acceleration"][5:-5], 8.0**2 / 12.0, rtol=0.01)
    np.testing.assert_allclose(scores.columns["yaw_rate"][5:-5], 8.0 / 12.0, rtol=0.01)
    assert scores.summary["c"] == 0.0 and scores.summary["comfort"]["lat_acceleration"]["within"] is False
    assert scores.summary["pdms"] == pytest.approx(10.0 / 12.0)
    assert scores.summary["ddc"] == 1.0


def test_a_lane_change():
    seconds, width, duration, speed = times(8.0, 0.05), 3.5, 6.0, 15.0
    phase = np.clip(seconds / duration, 0.0, 1.0)
    y = width * (phase - np.sin(2 * np.pi * phase) / (2 * np.pi))
    along_y = width / duration * (1.0 - np.cos(2 * np.pi * phase)) * (seconds < duration)
    yaw, whole = np.arctan2(along_y, speed), np.hypot(speed, along_y)
    path = poses(speed * seconds, y, yaw)
    scores = run_scores(driven(seconds, path, whole, recorded=poses(speed * seconds, 0.0, 0.0)))
    np.testing.assert_allclose(scores.columns["path_offset_m"], y, rtol=0.01, atol=1e-9)
    peak = 2 * np.pi * width / duration**2  # of the lateral acceleration in the road's frame
    assert scores.summary["comfort"]["lat_acceleration"]["max"] == pytest.approx(peak, rel=0.01)
    assert scores.summary["progress_m"] == pytest.approx(speed * 8.0, rel=0.01) and scores.summary["c"] == 1.0


def test_leaving_the_drivable_area():
    seconds = times(5.0)
    y = 0.5 * seconds  # half a width of 0.95 m from the edge at 2.2 m after 2.5 s
    run = driven(seconds, poses(10.0 * seconds, y, 0.0), 10.0, drivable=lambda places: places[:, 1] < 2.2001)
    scores = run_scores(run)
    np.testing.assert_array_equal(scores.columns["off_drivable"], (seconds > 2.505).astype(float))
    assert scores.summary["dac"] == scores.summary["pdms"] == scores.summary["alpasim_score"] == 0.0
    incident = {"kind": "off_drivable", "step": 26, "object": None, "at_fault": True, "second": pytest.approx(2.6)}
    assert scores.summary["first_incident"] == incident and scores.summary["offroad"] is True
    assert scores.summary["hugsim_pdms"] == pytest.approx(26 / 51) and scores.summary["alpasim_steps"] == 27


def test_without_a_drivable_area_nothing_is_said_about_it():
    scores = run_scores(straight(5.0, 10.0))
    assert scores.columns["off_drivable"] is None
    assert scores.summary["dac"] is None and scores.summary["offroad"] is None
    assert scores.summary["off_drivable_at_start"] is None
    assert scores.summary["not_known"] == ["dac", "offroad"]
    assert scores.summary["pdms"] == scores.summary["hugsim_pdms"] == 1.0


def test_beginning_off_the_drivable_area_does_not_count():
    run = straight(5.0, 10.0, drivable=lambda places: places[:, 0] > 20.0)
    scores = run_scores(run)
    assert scores.summary["off_drivable_at_start"] is True and scores.summary["dac"] == 1.0
    assert np.isnan(scores.columns["off_drivable"][:21]).all() and scores.summary["first_incident"] is None
    nowhere = run_scores(replace(run, drivable=lambda places: places[:, 0] > 1000.0))
    assert nowhere.summary["dac"] is None and "dac" in nowhere.summary["not_known"]
    assert nowhere.summary["off_drivable_at_start"] is True


@pytest.mark.parametrize(("speed", "compliance"), [(-1.9, 1.0), (-2.1, 0.5), (-5.9, 0.5), (-6.1, 0.0), (6.1, 1.0)])
def test_reversing_is_against_the_direction_of_the_path(speed, compliance):
    run = replace(straight(4.0, speed), recorded=straight(4.0, 10.0).ego_to_world)
    scores = run_scores(run)
    np.testing.assert_allclose(scores.columns["oncoming_m"][10:], max(-speed, 0.0), rtol=0.01)
    np.testing.assert_allclose(scores.columns["oncoming_m"][:11], max(-speed, 0.0) * run.seconds[:11], atol=1e-9)
    assert scores.summary["ddc"] == compliance
    assert scores.summary["progress_m"] == pytest.approx(4.0 * speed, rel=0.01)
    assert scores.summary["ep"] == pytest.approx(max(0.0, speed / 10.0), rel=0.01)


def test_standing_still():
    seconds = times(6.0)
    standing = poses(0.0 * seconds, 0.0, 0.0)
    scores = run_scores(driven(seconds, standing, 0.0, recorded=poses(10.0 * seconds, 0.0, 0.0)))
    assert scores.summary["progress_m"] == scores.summary["ep"] == scores.summary["rc"] == 0.0
    assert scores.summary["pdms"] == pytest.approx(7.0 / 12.0) and scores.summary["alpasim_score"] == 0.0
    both = run_scores(driven(seconds, standing, 0.0))
    assert both.summary["ep"] == both.summary["alpasim_score"] == both.summary["pdms"] == 1.0
    assert both.summary["rc"] is None and "rc" in both.summary["not_known"] and both.summary["progress_ratio"] is None


def test_after_the_end_of_the_recording_its_progress_is_unknown():
    run = straight(8.0, 10.0)
    short = replace(run, recorded_seconds=run.recorded_seconds[:41], recorded=run.recorded[:41])
    scores = run_scores(short)
    assert np.isnan(scores.columns["recorded_progress_m"][41:]).all()
    assert np.isnan(scores.columns["dist_to_gt_location"][41:]).all()
    assert scores.summary["recorded_progress_m"] == pytest.approx(40.0) and scores.summary["ep"] == 1.0
    late = run_scores(replace(short, loop_from=60))
    assert late.summary["ep"] is None and late.summary["alpasim_score"] is None and late.summary["ade_m"] is None
    assert late.summary["not_known"] == ["dac", "ep", "rc", "offroad"]
    assert late.summary["pdms"] == 1.0


def test_nothing_before_the_loop_counts():
    run = straight(8.0, 10.0, drivable=lambda places: np.abs(places[:, 1]) < 3.0)
    late = replace(run, loop_from=30, others=[car(run.seconds, 70.0, 5.0)])
    wild = late.ego_to_world.copy()
    wild[:30, 1, 3] = 50.0 * np.sin(np.arange(30.0))
    other = replace(late, ego_to_world=wild, speed=np.where(np.arange(81) < 30, -40.0, 10.0))
    first, second = run_scores(late), run_scores(other)
    assert first.summary == second.summary and first.summary["loop_from"] == 30
    assert first.summary["distance_m"] == pytest.approx(50.0) and first.summary["steps"] == 51
    for name, column in first.columns.items():
        assert np.isnan(column[:30]).all() and len(column) == 81, name
        np.testing.assert_array_equal(column, second.columns[name])
    assert first.columns["progress_m"][30] == 0.0 and first.columns["progress_m"][40] == pytest.approx(10.0)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_runs_of_few_steps(steps):
    run = straight((steps - 1) * 0.1, 10.0)
    scores = run_scores(replace(run, others=[car(run.seconds, 10.0, 0.0)]))
    assert len(run) == steps and scores.summary["steps"] == steps
    assert scores.summary["ttc"] == 0.0 and scores.columns["ttc_s"][0] == pytest.approx(0.43)
    assert (scores.summary["c"] is None) == (steps < 3)
    assert scores.summary["distance_m"] == pytest.approx(1.0 * (steps - 1))
    json.dumps(scores.summary, allow_nan=False)


def test_a_run_without_a_step_of_the_policy_is_refused():
    with pytest.raises(RequestError, match="loop_from is 11 of 11 steps"):
        run_scores(straight(1.0, 10.0, loop_from=11))


def test_alpasim_drops_what_follows_an_incident():
    """A car hits the ego vehicle from behind after 5 of 10 s; what it drives later is no progress."""
    run = straight(10.0, 10.0)
    other = car(run.seconds, -2.9 - 50.01 + 20.0 * run.seconds, 0.0)
    summary = run_scores(replace(run, others=[other])).summary
    assert summary["first_incident"]["kind"] == "collision_rear" and summary["first_incident"]["step"] == 51
    assert summary["progress_clipped_rel"] == pytest.approx(0.51, rel=0.01) and summary["alpasim_steps"] == 52
    assert summary["alpasim_score"] == pytest.approx(0.51 / 0.8, rel=0.01)
    assert summary["nc"] == 1.0 and summary["collision_at_fault"] is False and summary["ep"] == 1.0
    far = run_scores(beside(4.1)).summary
    assert far["alpasim_steps"] == 1 and far["alpasim_score"] == 0.0 and far["left_corridor_laterally"]


def test_the_score_leaves_out_what_is_not_known():
    assert pdm_score([1.0, 0.5], [(5.0, 1.0), (5.0, 0.4), (2.0, 0.0)]) == pytest.approx(0.5 * 7.0 / 12.0)
    assert pdm_score([1.0, None], [(5.0, 1.0), (5.0, 0.4), (2.0, None)]) == pytest.approx(0.7)
    assert pdm_score([0.0, None], [(5.0, 1.0), (5.0, None), (2.0, None)]) == 0.0


def busy() -> DrivenRun:
    """A run with a bend, a contact, objects on all sides and an edge of the drivable area."""
    seconds = times(6.0)
    angle = 8.0 * seconds / 40.0
    own = poses(40.0 * np.sin(angle), 40.0 * (1.0 - np.cos(angle)) + 0.2 * seconds, angle + 0.02)
    recorded = poses(40.0 * np.sin(angle), 40.0 * (1.0 - np.cos(angle)), angle)
    others = [
        car(seconds, 38.0, 25.0, 0.9, id="ahead"), car(seconds, -20.0 + 6.0 * seconds, 0.3, id="behind"),
        car(seconds, 20.0, 30.0 - 5.0 * seconds, -1.5, present=seconds < 4.0, id="crossing"),
    ]  # fmt: skip
    return driven(seconds, own, 8.0, others, recorded, lambda places: places[:, 1] < 26.0, loop_from=5)


@settings(max_examples=25)
@given(st.floats(-np.pi, np.pi), st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-50.0, 50.0))
def test_moving_the_whole_world_changes_nothing(yaw, x, y, z):
    run = busy()
    before = run_scores(run)
    assert before.summary["collisions"] and before.summary["dac"] == 0.0 and before.summary["ttc"] == 0.0
    after = run_scores(moved(run, poses([x], y, yaw, z)[0]))
    assert same(before.summary, after.summary)
    for name, column in before.columns.items():
        np.testing.assert_allclose(after.columns[name], column, rtol=1e-5, atol=1e-5, err_msg=name)


def same(a, b) -> bool:
    """Whether plain data are equal, numbers up to rounding."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    return a == pytest.approx(b, rel=1e-5, abs=1e-5) if isinstance(a, float) else a == b


@settings(max_examples=40)
@given(st.floats(0.5, 20.0), st.floats(-1.5, 1.5), st.integers(0, 20))
def test_ratios_are_between_0_and_1_and_the_summary_is_plain_data(speed, yaw_rate, loop_from):
    seconds = times(4.0)
    yaw = yaw_rate * seconds
    x = speed * np.concatenate([[0.0], np.cumsum(0.1 * np.cos(yaw))])[:-1]
    y = speed * np.concatenate([[0.0], np.cumsum(0.1 * np.sin(yaw))])[:-1]
    run = driven(seconds, poses(x, y, yaw), speed, [car(seconds, 30.0, 2.0)], poses(8.0 * seconds, 0.0, 0.0))
    scores = run_scores(replace(run, loop_from=loop_from))
    json.dumps(scores.summary, allow_nan=False)
    for name in ("nc", "ttc", "ep", "c", "ddc", "rc", "pdms", "hugsim_pdms", "hd_score", "alpasim_score"):
        assert scores.summary[name] is None or 0.0 <= scores.summary[name] <= 1.0, name
    assert (scores.columns["ttc_s"][loop_from:] >= 0.0).all()


def documented() -> dict[str, set[str]]:
    """The names in the tables of docs/closed_loop.md, by the heading above."""
    page = (REPOSITORY / "docs/closed_loop.md").read_text(encoding="utf-8")
    parts = re.split(r"^### (.+)$", page, flags=re.MULTILINE)
    found = {}
    for title, text in zip(parts[1::2], parts[2::2], strict=True):
        rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", text, re.MULTILINE)
        found[title] = {name for row in rows for name in re.findall(r"\w+", row)}
    return found


def test_the_page_lists_every_column_and_every_value_of_the_summary():
    scores: RunScores = run_scores(busy())
    assert documented()["Columns"] == set(scores.columns)
    assert documented()["Summary"] == set(scores.summary)
