"""Planning of scenes without cameras: what they have, and what is refused in one sentence."""

import json
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.settings.config import load
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import TRAINING_INPUTS, stage_settings
from drivesplat.workflow.without_cameras import CAMERA_STAGES, methods_left_out, require_methods

ALONE = {"cameras": [], "eval_camera": None}
SCANS = {"per_image": 0.25, "fine_tune": 0.2, "geometry": 0.3}
ACTORS = {"parts": ["background", "actors"]}
LIDAR = {"overrides": {"train": {"depth_weight": 0.01, "scans": SCANS}}}
METHODS = {"vanilla": {}, "street": ACTORS, "with_lidar": ACTORS | LIDAR}


def settings(**values: Any) -> dict[str, Any]:
    """Scene a1 with a camera beside a2 without one."""
    datasets = {"a": {"scenes": ["a1"]}, "b": {"scenes": ["a2"], "overrides": ALONE}}
    return {"datasets": datasets, "methods": METHODS, "results_dir": "there", **values}


def plan(**values: Any) -> Plan:
    return Plan(settings(**values), str(REPOSITORY))


def at(scene: str, method: str = "with_lidar") -> SimpleNamespace:
    return SimpleNamespace(scene=scene, method=method)


def test_a_batch_measures_it_by_the_methods_that_render_lidar_and_shows_its_scans_alone():
    made = plan()
    assert made.metrics() == ["there/a1/metrics.json", "there/a2/metrics.json"]
    assert made.evals(at("a1")) == [f"there/a1/{method}/eval.json" for method in METHODS]
    assert made.evals(at("a2")) == ["there/a2/with_lidar/eval.json"]
    report = made.report([])
    shown = [*made.films(), *made.looks(), *made.exports(), *made.drives(), *made.edits(), *report.pictures()]
    of_alone = {path for path in (*shown, *report.links()) if "/a2/" in path}
    scans = {"there/a2/with_lidar/lidar.png", "there/a2/with_lidar/lidar.mp4"}
    assert of_alone == {*scans, "there/a2/index.html"}, "the page of its films"
    assert "there/a1/vanilla/ghost_panel.png" in shown and "there/a1/street/original.mp4" in shown
    assert made.trained(cameras=True) == "a1" and made.trained(cameras=False) == "a2"


def test_its_training_takes_no_result_of_images_and_fits_scans_alone():
    made = plan()
    assert made.of_images("masks/masks.json")(at("a1")) == ["there/a1/masks/masks.json"]
    assert made.of_images("masks/masks.json")(at("a2")) == []
    assert made.annotated_scene(at("a2")) == "there/a2/scene_refined.json", "LiDAR refines poses alone"
    taken = {scene: [i for i in TRAINING_INPUTS if made.training_input(i)(at(scene))] for scene in ("a1", "a2")}
    assert taken == {"a1": ["actors", "lidar_depth", "scans"], "a2": ["actors", "scans"]}
    with_image, alone = (json.loads(made.settings("train")(at(scene))) for scene in ("a1", "a2"))
    assert (with_image["train"]["scans"]["per_image"], with_image["sky"]) == (0.25, "cubemap")
    assert (alone["train"]["scans"]["per_image"], alone["sky"], alone["reference_camera"]) == (1.0, "none", None)
    scans = [train["train"]["scans"] for train in (with_image, alone)]
    shared = [(settings["fine_tune"], settings["geometry"]) for settings in scans]
    assert shared == [(0.2, 0.3), (0.0, 1.0)], "no image has to be spared"


def test_the_report_expects_its_own_stages():
    expected = json.loads(plan().report([]).settings())["expected"]
    own = {"extract", "parser", "actors", "scans", "scan_baselines", "scene_metrics"}
    assert expected["a2"].keys() >= {*own, "with_lidar/train", "with_lidar/evaluate_scans"}
    assert not {stage for stage in expected["a2"] if stage.split("/")[-1] in CAMERA_STAGES or "street" in stage}
    assert "with_lidar/evaluate_scans" not in expected["a1"] and "street/evaluate" in expected["a1"]


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("vanilla/eval.json", "and method 'vanilla' renders images alone; those that render LiDAR: with_lidar"),
        ("with_lidar/original.mp4", ": with_lidar/original.mp4 needs images; docs/lidar.md"),
        *(
            (target, f"{target} needs images")
            for target in (
                "with_lidar/ghost_panel.png", "with_lidar/edits/away/scans/scans.json", "with_lidar/splat.ply",
                "with_lidar/trajectories/original/drive/drive.json", "masks/masks.json", "seed.ply", "ablation.csv",
            )
        ),
    ],
)  # fmt: skip
def test_a_result_that_needs_images_is_refused_by_name(target, words):
    made = plan(ablation={"of": "with_lidar"})
    with pytest.raises(ConfigError) as refused:
        made.refuse_unknown([f"there/a2/{target}"])
    assert str(refused.value).startswith("scene a2 has no camera (cameras: [])") and words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_it_has_is_not_refused():
    made = plan()
    of_scene = ("scene.json", "parser.npz", "actors.npz", "scans.npz", "scan_baselines.json", "metrics.json")
    scans = "trajectories/original/scans/scans.json"
    of_method = ("checkpoint.npz", "train.json", "eval.json", "lidar.png", "lidar.mp4", scans)
    made.refuse_unknown([f"there/a2/{name}" for name in (*of_scene, *(f"with_lidar/{name}" for name in of_method))])


def test_stages_of_images_have_no_settings_there():
    """Whoever asks for their results: also another workflow, whose targets are unknown."""
    config = load(settings())
    for stage in CAMERA_STAGES:
        with pytest.raises(ConfigError, match=rf"^scene a2 has no camera .*the stage {stage} needs images$"):
            stage_settings(config, stage, "a2", "with_lidar", "original")


def test_scans_of_trajectories_take_no_camera_and_those_of_edits_are_refused():
    config = load(settings(cameras=["CAM_FRONT"]))
    of = ("with_lidar", "trajectories/original")
    with_image, alone = (json.loads(stage_settings(config, "scan_folder", scene, *of)) for scene in ("a1", "a2"))
    assert (with_image["eval_camera"], alone["eval_camera"]) == ("CAM_FRONT", None)
    assert alone["trajectory"] == with_image["trajectory"]
    with pytest.raises(ConfigError, match=r"^scene a2 has no camera .*: scans of edits need images; docs/lidar.md"):
        stage_settings(config, "scan_folder", "a2", "with_lidar", "edits/away")


def test_planning_names_the_methods_that_it_leaves_out_and_refuses_a_scene_without_any():
    config, images_alone = load(settings()), load(settings(methods={"vanilla": {}}))
    (sentence,) = methods_left_out(config, ["a1", "a2"])
    assert sentence.startswith("dataset b has no camera") and sentence.endswith("left out there (vanilla, street)")
    assert methods_left_out(config, ["a1"]) == []
    require_methods(images_alone, "a1")
    with pytest.raises(ConfigError, match=r"scene a2 has no camera .*no method renders LiDAR; .*presets/lidar.yaml"):
        require_methods(images_alone, "a2")


def test_a_camera_of_a_dataset_without_any_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "drive.json").write_text('{"lidars": {"top": {}}}', encoding="utf-8")
    mine = {"reader": "drive", "dataroot": str(tmp_path), "scenes": ["m1"]}
    values = {"results_dir": str(tmp_path / "results"), "methods": METHODS}
    made = Plan({"datasets": {"m": mine}, **values}, str(REPOSITORY))
    with pytest.raises(ConfigError, match=r"dataset m has no camera, but cameras names CAM_FRONT; write cameras: \[\]"):
        made.refuse_absent_data([])
    Plan({"datasets": {"m": {**mine, "overrides": ALONE}}, **values}, str(REPOSITORY)).refuse_absent_data([])
    gone = {**mine, "dataroot": str(tmp_path / "gone"), "overrides": ALONE}
    with pytest.raises(DatasetError, match="drive folder not found"):
        Plan({"datasets": {"m": gone}, **values}, str(REPOSITORY)).refuse_absent_data([])
