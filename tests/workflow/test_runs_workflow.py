"""Runs in the closed loop as rules: what is driven, when again, and what a failed policy leaves."""

import pytest
import yaml
from helpers.killed_runs import refusal_by_plan
from helpers.workflow_copy import WorkflowCopy

from drivesplat.io.video import read_footage

pytestmark = pytest.mark.workflow
RUNS = {
    "brakes": {"policy": "pure_pursuit", "edit": "stop", "simulation": {"seconds": 0.6}, "film_width": 64},
    "mine": {"policy": "my_policy:Mine", "simulation": {"seconds": 0.4, "cameras": []}, "film_width": 64},
    "elsewhere": {"policy": "recorded", "methods": ["vanilla"], "film_width": 64, "simulation": {"seconds": 0.3}},
}
MINE = "class Mine:\n    def act(self, seen, facts):\n        {}\n"
BRAKES, OWN = (f"results/0001/street/runs/{name}.json" for name in ("brakes", "mine"))


@pytest.fixture(scope="module")
def copy(finished_run, tmp_path_factory) -> WorkflowCopy:
    made = finished_run.again(tmp_path_factory.mktemp("runs") / "workflow")
    write_runs(made, RUNS)
    (made.folder / "my_policy.py").write_text(MINE.format("return [0.0, -1.0]"))
    made.config["runs"] = "runs.yaml"
    made.write_config()
    return made


def write_runs(copy: WorkflowCopy, runs: dict) -> None:
    (copy.folder / "runs.yaml").write_text(yaml.safe_dump({"runs": runs}))


def test_runs_are_made_of_their_methods_and_again_only_where_something_changed(copy):
    assert copy.planned("runs")["run"] == 3
    done = copy.run("runs")
    assert done.returncode == 0, done.stdout
    record = copy.read(BRAKES)
    assert record["schema"] == 1 and record["failed"] is None and record["edit"]["steps"]
    (episode,) = record["episodes"]
    assert len(episode["path"]) == 7 and episode["scores"]["duration_s"] == pytest.approx(0.6)
    assert len(episode["validity"]) == len(episode["expected_psnr"]) == 7
    assert all(0.0 <= value <= 1.0 for value in episode["validity"])
    assert read_footage(copy.folder / BRAKES.replace(".json", ".mp4")).frames == 7
    assert copy.read(OWN)["failed"] is None
    assert (copy.folder / "results/0001/vanilla/runs/elsewhere.mp4").is_file()
    assert "run" not in copy.planned("runs")
    done = copy.run("results/0001/index.html")
    page = (copy.folder / "results/0001/index.html").read_text()
    assert done.returncode == 0 and "run brakes: pure_pursuit drives after the edit stop" in page
    write_runs(copy, {**RUNS, "brakes": {**RUNS["brakes"], "seeds": [1]}})
    assert copy.planned("runs") == {"run": 1, "runs": 1}
    write_runs(copy, RUNS)
    (copy.folder / "my_policy.py").write_text(MINE.format("raise ValueError('no idea')"))
    assert copy.planned("runs") == {"run": 1, "runs": 1}
    done = copy.run("runs", "results/gap_report.json")
    assert done.returncode == 0, done.stdout
    assert copy.read(OWN)["failed"] == "at 0.00 s: the policy's `act` raised ValueError: no idea"
    rows = {row["run"]: row for row in copy.read("results/gap_report.json")["runs"]}
    assert set(rows) == set(RUNS) and rows["mine"]["failed"] and not rows["brakes"]["failed"]


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            "results/0001/street/runs/fast.json",
            "method street has no run called 'fast' on scene 0001; there are: brakes",
        ),
        ("results/0001/street/runs/fast/drive.mcap", "no run called 'fast'"),
        ("results/0001/street/runs/fast/drive/drive.json", "no run called 'fast'"),
        ("results/0001/vanilla/runs/brakes.json", "method vanilla has no run called 'brakes'"),
    ],
)
def test_unknown_runs_are_refused_before_anything_starts(copy, target, message):
    assert message in refusal_by_plan(copy, target)


def test_a_run_with_an_unknown_edit_or_scene_is_refused(copy):
    for change, message in (
        ({"edit": "fly", "scenes": ["0001"]}, "no edit called 'fly'"),
        ({"scenes": ["0009"]}, "0009"),
        ({"methods": ["stret"]}, "no method 'stret'"),
    ):
        write_runs(copy, {**RUNS, "brakes": {**RUNS["brakes"], **change}})
        try:
            assert message in refusal_by_plan(copy, "runs")
        finally:
            write_runs(copy, RUNS)
