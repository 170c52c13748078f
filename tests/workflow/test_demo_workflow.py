"""From nothing to measured splats of a synthetic world, on the CPU, as users run it."""

import json

import numpy as np
import pytest
from helpers.workflow_copy import WorkflowCopy

from drivesplat.settings.config import merged

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("demo_workflow")]

TARGET = "results/demo/metrics.json"
AFTER_THE_WORLD = {
    "extract": 1, "own_car": 1, "lidar_seed": 1, "parser": 1, "masks": 1, "actors": 1, "lidar_depth": 1, "train": 2,
    "evaluate": 2, "scene_metrics": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> WorkflowCopy:
    """The workflow run to the end for a small world, beside a recorded drive; methods and device are left to it."""
    demo = {
        "dataroot": "resources/demo",
        "scenes": ["demo"],
        "batch": False,
        "world": {"width": 128, "key_frames": 6, "samples_per_pixel": 1},
        "overrides": {"train": {"iterations": 30}, "lidar_seed": {"max_points": 500, "far_points": 100}},
    }
    workflow = WorkflowCopy.make(
        tmp_path_factory.mktemp("demo"),
        datasets={"nuscenes": {"dataroot": "data", "scenes": ["0001"]}, "demo": demo},
        holdout={"every_nth": 3, "offset": 2, "last_block": 1},
        device="auto",
    )
    done = workflow.run(TARGET)
    assert done.returncode == 0, done.stdout
    return workflow


def test_metrics_come_from_nothing_on_the_cpu(finished):
    metrics = finished.read(TARGET)
    assert (metrics["scene"], metrics["dataset"]) == ("demo", "demo")
    assert (metrics["protocol"]["width"], metrics["protocol"]["height"]) == (128, 72)
    assert metrics["protocol"]["held_out_frames"] == {"interpolation": [2], "extrapolation": [5]}
    assert metrics["methods"].keys() == {"vanilla", "street"}
    for method, result in metrics["methods"].items():
        assert result["interpolation"]["all"]["psnr"] > 8.0
        depth = result["interpolation"]["depth"]
        assert 0.0 < depth["median_relative_error"] < 3.0 and depth["pixels"] > 1000
        assert finished.read(f"results/demo/{method}/train.json")["device"].startswith("cpu")


def test_what_only_a_synthetic_world_knows_is_measured_too(finished):
    result = finished.read(TARGET)["methods"]["vanilla"]
    assert set(result["lateral"]) == {"2.0", "-2.0", "4.0"}
    for view in result["lateral"].values():
        assert set(view) == {"all", "static", "moving_vehicle", "depth"}
        assert view["all"]["pixels"] == 6 * 128 * 72
        assert view["static"]["psnr"] > 8.0
        assert 0.0 < view["depth"]["median_relative_error"] < np.inf
        assert 1000 < view["depth"]["pixels"] < view["static"]["pixels"]
    removal = result["removal"]
    assert set(removal) == {"box", "outside", "not_removed"} and set(removal["not_removed"]) == {"box", "outside"}
    for region in ("box", "outside"):
        assert removal[region]["psnr"] > 8.0
        assert removal[region]["pixels"] == removal["not_removed"][region]["pixels"]


def test_the_world_and_its_truth_lie_at_the_dataroot(finished):
    root = finished.folder / "resources/demo"
    assert {path.name for path in root.iterdir()} == {"maps", "samples", "truth", "v1.0-mini", "world.json"}
    views = json.loads((root / "truth/truth.json").read_text())["views"]
    assert [view["left_m"] for view in views if view["without"] is None] == [0.0, 2.0, -2.0, 4.0]
    assert all(len(view["frames"]) == 6 for view in views)


def test_a_second_call_plans_nothing(finished):
    assert finished.planned(TARGET) == {}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"world": {"random_seed": 5}}, {"demo_world_demo": 1, **AFTER_THE_WORLD}),
        ({"overrides": {"sweeps": True}}, {"demo_world_demo": 1, **AFTER_THE_WORLD}),
        ({"overrides": {"train": {"iterations": 31}}}, {"train": 2, "evaluate": 2, "scene_metrics": 1}),
        ({"device": {"kind": "cpu"}, "batch": True}, {}),
    ],
)
def test_a_changed_setting_remakes_the_world_only_if_it_is_one_of_the_worlds(finished, changes, expected):
    before = finished.config
    device = changes.get("device", before["device"])
    demo = merged(before["datasets"]["demo"], {key: value for key, value in changes.items() if key != "device"})
    finished.config = {**before, "device": device, "datasets": {**before["datasets"], "demo": demo}}
    finished.write_config()
    try:
        assert finished.planned(TARGET) == expected
    finally:
        finished.config = before
        finished.write_config()


def test_without_a_target_the_demo_stays_out(finished):
    done = finished.run(flags=("-n",))
    assert done.returncode == 0, done.stdout
    assert "results/0001/metrics.json" in done.stdout and "results/demo" not in done.stdout


def test_a_recorded_drive_is_still_refused_without_a_gpu(finished):
    done = finished.run("results/0001/vanilla/checkpoint.npz")
    assert done.returncode != 0
    assert "no usable GPU" in done.stdout and "device: cpu" in done.stdout
    assert "Traceback" not in done.stdout
    assert not (finished.folder / "results/0001/vanilla/checkpoint.npz").exists()


def test_a_world_at_a_recorded_datasets_folder_is_refused_before_any_job(finished):
    before = finished.config
    finished.config = merged(before, {"datasets": {"demo": {"dataroot": "data"}}})
    finished.write_config()
    tables = {path: path.read_bytes() for path in (finished.folder / "data").rglob("*.json")}
    try:
        done = finished.run(TARGET)
    finally:
        finished.config = before
        finished.write_config()
    assert done.returncode != 0
    line = next(line for line in done.stdout.splitlines() if line.startswith("drivesplat:"))
    assert "data is configured for a synthetic world, but holds other files" in line
    assert "Traceback" not in done.stdout and tables
    assert {path: path.read_bytes() for path in tables} == tables
