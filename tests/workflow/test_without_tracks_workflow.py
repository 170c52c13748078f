"""A drive folder without boxes beside tables with boxes through the workflow, with the shipped methods."""

import json
from contextlib import chdir
from pathlib import Path

import pytest
from helpers.workflow_copy import WorkflowCopy, complaints

from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.scene import read_scene

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("without_tracks_workflow")]
METRICS = "results/bare/metrics.json"


@pytest.fixture(scope="module")
def copy(finished_run, tmp_path_factory) -> WorkflowCopy:
    """The tiny drive's tables, and the drive folder written from them, without its tracks, as another scene."""
    made = finished_run.again(tmp_path_factory.mktemp("bare") / "workflow")
    made.config["datasets"] = {
        "nuscenes": {"dataroot": "data", "scenes": ["0001"]},
        "mine": {"reader": "drive", "dataroot": "drives", "scenes": ["bare"]},
    }
    del made.config["methods"]
    made.write_config()
    with chdir(made.folder):
        write_drive(read_scene("results/0001/scene.json"), Path("drives/bare"))
        drive = Path("drives/bare/drive.json")
        drive.write_text(json.dumps({**json.loads(drive.read_text()), "tracks": []}))
    return made


def test_a_batch_plans_the_methods_of_each_drive_and_says_so(copy):
    done = copy.run("metrics", flags=("-n",))
    assert done.returncode == 0, done.stdout
    assert complaints(done.stdout) == {
        "drivesplat: scene bare has no boxes: street_discovered takes the place of street, since its objects are found "
        "in LiDAR scans; methods there: vanilla, street_discovered (docs/without_boxes.md)"
    }
    trained = {
        line.split(": ")[1] for line in done.stdout.splitlines() if line.startswith("    wildcards: scene=bare, method")
    }
    assert {name.split("method=")[1] for name in trained} == {"vanilla", "street_discovered"}


@pytest.mark.slow
def test_a_drive_without_boxes_is_trained_and_measured_by_default(copy):
    done = copy.run(METRICS)
    assert done.returncode == 0, done.stdout
    methods = copy.read(METRICS)["methods"]
    assert {name: method["tracks"] for name, method in methods.items()} == {
        "vanilla": "annotated", "street_discovered": "discovered"
    }  # fmt: skip
    assert all(method["interpolation"]["static"]["psnr"] > 5.0 for method in methods.values())
    assert copy.planned(METRICS) == {}
    costs = copy.read("results/costs.json")["scenes"]
    assert {total["scene"]: total["complete"] for total in costs}["bare"]
