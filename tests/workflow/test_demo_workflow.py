"""From nothing to measured splats of a synthetic world, on the CPU, as users run it."""

from typing import Any

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
    small = {"train": {"iterations": 30}, "lidar_seed": {"max_points": 500, "far_points": 100}}
    world = {"width": 128, "key_frames": 6, "samples_per_pixel": 1}
    demo = {"dataroot": "resources/demo", "scenes": ["demo"], "batch": False, "world": world, "overrides": small}
    workflow = WorkflowCopy.make(
        tmp_path_factory.mktemp("demo"),
        datasets={"nuscenes": {"dataroot": "data", "scenes": ["0001"]}, "demo": demo},
        holdout={"every_nth": 3, "offset": 2, "last_block": 1},
        device="auto",
    )
    done = workflow.run(TARGET)
    assert done.returncode == 0, done.stdout
    return workflow


def demo(**changes: Any) -> dict[str, Any]:
    """Other settings of the demo's dataset."""
    return {"datasets": {"demo": changes}}


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
        assert set(view) == {"all", "static", "moving_vehicle", "road", "markings", "depth"}
        assert view["all"]["pixels"] == 6 * 128 * 72
        assert view["static"]["psnr"] > 8.0
        assert 0.0 < view["depth"]["median_relative_error"] < np.inf
        assert 1000 < view["depth"]["pixels"] < view["static"]["pixels"]
    removal = result["removal"]
    assert set(removal) == {"box", "outside", "not_removed"} and set(removal["not_removed"]) == {"box", "outside"}
    for region in ("box", "outside"):
        assert removal[region]["psnr"] > 8.0
        assert removal[region]["pixels"] == removal["not_removed"][region]["pixels"]


def test_a_second_call_plans_nothing(finished):
    assert finished.planned(TARGET) == {}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (demo(world={"random_seed": 5}), {"demo_world_demo": 1, **AFTER_THE_WORLD}),
        (demo(overrides={"sweeps": True}), {"demo_world_demo": 1, **AFTER_THE_WORLD}),
        (demo(overrides={"train": {"iterations": 31}}), {"train": 2, "evaluate": 2, "scene_metrics": 1}),
        ({"device": "cpu", **demo(batch=True)}, {}),
    ],
)
def test_a_changed_setting_remakes_the_world_only_if_it_is_one_of_the_worlds(finished, changes, expected):
    with finished.set_to(**merged(finished.config, changes)):
        assert finished.planned(TARGET) == expected


def test_without_a_target_the_demo_stays_out(finished):
    done = finished.run(flags=("-n",))
    assert done.returncode == 0, done.stdout
    assert "results/0001/metrics.json" in done.stdout and "results/demo" not in done.stdout
