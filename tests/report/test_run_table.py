"""Runs in the closed loop in the report."""

import json
from pathlib import Path

import pytest
from helpers.reports import group, method, metrics, report_of

from drivesplat.errors import ResultError
from drivesplat.report.files import report_page
from drivesplat.report.runs import run_rows, run_table

SCORES = {"pdms": 0.79, "hd_score": 0.55, "alpasim_score": 0.62, "progress_ratio": 0.5, "duration_s": 9.5}
HIT = {"kind": "collision_front", "step": 50, "object": "car", "at_fault": True, "second": 5.0}


def episode(seed: int = 0, failed=None, incident=None) -> dict:
    ended = "a failed policy" if failed else "the end of its time"
    return {"seed": seed, "ended": ended, "failed": failed, "scores": {**SCORES, "first_incident": incident}}


def written(tmp_path: Path, *episodes: dict, failed=None, name: str = "brakes") -> str:
    path = tmp_path / "demo/street/runs" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"run": {"policy": "mine:Policy"}, "failed": failed, "episodes": list(episodes)}))
    return str(path)


def test_every_episode_is_a_row_that_says_what_happened(tmp_path):
    rows = run_rows([written(tmp_path, episode(), episode(1, incident=HIT), episode(2, failed="at 0.10 s: no"))])
    assert [(row["run"], row["scene"], row["method"], row["policy"]) for row in rows] == [
        ("brakes", "demo", "street", "mine:Policy")
    ] * 3
    assert [row["what"] for row in rows] == [
        "the end of its time", "collision front at 5.0 s, at fault", "at 0.10 s: no"
    ]  # fmt: skip
    assert [row["failed"] for row in rows] == [False, False, True] and rows[0]["pdms"] == 0.79


def test_a_run_without_a_policy_is_a_row_without_figures(tmp_path):
    (row,) = run_rows([written(tmp_path, failed="there is no policy 'fast'")])
    assert row["what"] == "there is no policy 'fast'" and row["failed"] and row["seed"] is None
    assert all(row[column["key"]] is None for column in run_table([])["columns"])


@pytest.mark.parametrize("text", ["{", "[]", '{"episodes": []}', '{"run": {"policy": "x"}, "episodes": [3]}'])
def test_what_is_no_record_of_a_run_is_named(tmp_path, text):
    path = Path(written(tmp_path))
    path.write_text(text)
    with pytest.raises(ResultError, match=r"brakes\.json"):
        run_rows([str(path)])


def test_the_page_has_a_table_of_runs_where_there_are_some(tmp_path):
    nothing = report_of(tmp_path, metrics("0061", {"vanilla": method(group(25.0), group(22.0))}), methods=("vanilla",))
    without = report_page(nothing, {})
    shown = report_page({**nothing, "runs": run_rows([written(tmp_path, episode(incident=HIT))])}, {})
    assert 'id="runs"' not in without
    assert 'id="runs"' in shown and "collision front at 5.0 s, at fault" in shown and "0.79" in shown
