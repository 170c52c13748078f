"""A drive folder without cameras beside a drive with one, through the whole workflow."""

import pytest
from helpers.swept_street import write_swept_street
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("lidar_alone_workflow")]
LIDAR = {"train": {"scans": {"per_image": 0.4, "points": 1500}}}
METHODS = {"vanilla": {"parts": ["background"]}, "with_lidar": {"parts": ["background", "actors"], "overrides": LIDAR}}
METRICS = "results/swept/metrics.json"


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    folder = tmp_path_factory.mktemp("alone") / "workflow"
    made = WorkflowCopy.make(folder, methods=METHODS, train={**TINY_TRAINING, "iterations": 20})
    write_swept_street(folder / "drives/swept")
    made.config["datasets"]["mine"] = {
        "reader": "drive",
        "dataroot": "drives",
        "scenes": ["swept"],
        "overrides": {"cameras": [], "eval_camera": None, "holdout": {"every_nth": 4, "offset": 2, "last_block": 1}},
    }
    made.write_config()
    return made


def test_a_batch_plans_its_own_stages_beside_those_of_a_scene_with_a_camera(copy):
    planned = copy.planned("all")
    assert (planned["extract"], planned["train"], planned["evaluate"], planned["evaluate_scans"]) == (2, 3, 2, 1)
    assert planned["masks"] == planned["own_car"] == planned["lidar_seed"] == planned["tracks"] == 1
    assert planned["scene_metrics"] == 2 and planned["gap_report"] == 1


def test_it_is_measured_and_reported(copy):
    done = copy.run(METRICS)
    assert done.returncode == 0, done.stdout
    said = "dataset mine has no camera (cameras: []): methods that render images alone are left out there"
    assert said in done.stdout
    record = copy.read(METRICS)
    assert record["methods"].keys() == {"with_lidar"} and record["protocol"]["train_scans"] == 5
    figures = record["methods"]["with_lidar"]["interpolation"]
    assert figures["static"] is None and figures["lidar"]["all"]["range_error_median_m"] < 2.0
    made = {path.name for path in (copy.folder / "results/swept").iterdir()}
    assert not made & {"masks", "own_car.json", "seed.ply", "lidar_depth.npz"}, made
    done = copy.run("report")
    assert done.returncode == 0, done.stdout
    report = copy.read("results/gap_report.json")
    assert [row["scene"] for row in report["rows"]] == ["swept"] and report["left_out"] == []
    assert copy.planned(METRICS) == {}


def test_what_it_lacks_is_refused_in_one_line(copy):
    """tests/workflow/test_without_cameras.py has each by itself."""
    done = copy.run("results/swept/with_lidar/original.mp4", flags=("-n",))
    said = [line for line in done.stdout.splitlines() if line.startswith("drivesplat: scene swept has no camera")]
    assert done.returncode != 0 and len(said) == 1 and "with_lidar/original.mp4 needs images" in said[0]
    assert "Traceback" not in done.stdout
