"""What rules ask of the plan: inputs that only some methods take, and what a report may expect."""

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.settings.report import HELD_OUT_PAIR, LIDAR_LOOKS, PICTURES
from drivesplat.workflow import inputs
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import SCENE_STAGES, TRAINING_INPUTS, refines_poses, stage_settings

ACTORS = ["background", "actors"]
DRIFTING = ["background", "drifting"]
HELD = {"train": {"depth_weight": 0.01}}
LIDAR = {"train": {"scans": {"per_image": 0.3}}}


def plan(**values: Any) -> Plan:
    datasets = {"a": {"scenes": ["a1", "a2"]}, "b": {"scenes": ["b1"], "overrides": values.pop("b", {})}}
    as_recorded = {"refine_poses": {"enabled": False}}
    return Plan({"datasets": datasets, "results_dir": "elsewhere", **as_recorded, **values}, str(REPOSITORY))


def taken(made: Plan, scene: str, method: str) -> list[str]:
    at = SimpleNamespace(scene=scene, method=method)
    return [file for stage in TRAINING_INPUTS for file in made.training_input(stage)(at)]


def test_a_dataset_without_scene_tables_names_the_files_of_each_scene(monkeypatch, tmp_path):
    """A scene that is added to it reruns no other."""
    files = SimpleNamespace(
        find_root=lambda dataroot, _: Path(dataroot),
        table_files=lambda root, version, scene: [root / version / scene / "poses.json"],
    )
    monkeypatch.setattr(inputs, "layout", lambda _: files)
    monkeypatch.setattr(inputs, "index", lambda _: None)
    dataset = {"dataroot": "there", "version": "v1", "scenes": ["a1", "a2"]}
    made = Plan({"datasets": {"a": dataset}, "results_dir": str(tmp_path)}, str(REPOSITORY))
    for scene in ("a1", "a2"):
        at = SimpleNamespace(scene=scene)
        assert made.tables(at) == [f"{tmp_path}/.data/a/v1/{scene}/poses.json"] and made.scene_tables(at) == []


def test_inputs_of_a_training_follow_its_parts_and_the_overrides_of_dataset_and_method():
    free = {"overrides": {"train": {"depth_weight": 0.0}}}
    made = plan(methods={"vanilla": {}, "free": free, "mine": {"parts": ACTORS}}, b=HELD)
    depth, actors = ([f"elsewhere/b1/{stage}.npz"] for stage in ("lidar_depth", "actors"))
    inputs = {(scene, method): taken(made, scene, method) for scene in ("a1", "b1") for method in made.config.methods}
    assert inputs == {
        ("a1", "vanilla"): [], ("b1", "vanilla"): depth, ("a1", "free"): [], ("b1", "free"): [],
        ("a1", "mine"): ["elsewhere/a1/actors.npz"], ("b1", "mine"): [*actors, *depth],
    }  # fmt: skip
    everywhere = plan(methods={"vanilla": {}, "free": free}, train={"depth_weight": 0.1})
    assert [bool(taken(everywhere, scene, "vanilla")) for scene in ("a1", "b1")] == [True, True]
    assert taken(everywhere, "a1", "free") == []


@pytest.mark.parametrize(
    ("methods", "more"),
    [
        ({"vanilla": {}}, {"a1": set(), "b1": {"lidar_depth"}}),
        ({"vanilla": {}, "mine": {"parts": ACTORS}}, {"a1": {"actors"}, "b1": {"actors", "lidar_depth"}}),
        ({"vanilla": {}, "held": {"overrides": HELD}}, {"a1": {"lidar_depth"}, "b1": {"lidar_depth"}}),
        ({"vanilla": {}, "lidar": {"overrides": LIDAR}},
         {"a1": {"scans", "scan_baselines"}, "b1": {"scans", "scan_baselines", "lidar_depth"}}),
    ],
)  # fmt: skip
def test_a_report_expects_them_where_a_method_of_the_scene_takes_them(methods, more):
    made = plan(methods=methods, b=HELD)
    expected = json.loads(made.report([]).settings())["expected"]
    assert expected.keys() == {"a1", "a2", "b1"}
    for scene, stages in more.items():
        assert {name for name in expected[scene] if "/" not in name} == {*SCENE_STAGES, *stages}
        for stage in stages:
            assert expected[scene][stage]["code"] == made.code(stage)
            assert expected[scene][stage]["settings"] == json.loads(stage_settings(made.config, stage, scene))


REFINED = {"refine_poses": {"enabled": True}}


def test_all_stages_take_the_refined_scene_where_poses_are_refined():
    made = plan(b=REFINED)
    scenes = {name: made.scene(SimpleNamespace(scene=name)) for name in ("a1", "b1")}
    assert scenes == {"a1": "elsewhere/a1/scene.json", "b1": "elsewhere/b1/scene_refined.json"}


@pytest.mark.parametrize(
    ("world", "enabled", "refined"),
    [
        (None, "auto", True), (None, True, True), (None, False, False),
        ({}, "auto", False), ({}, True, True), ({"pose_noise": True}, "auto", True),
    ],
)  # fmt: skip
def test_poses_are_refined_unless_they_are_known_to_be_exact(world, enabled, refined):
    """Of recorded drives, and of worlds whose poses are as noisy; the default is 'auto'."""
    dataset = {"dataroot": "resources/w", "scenes": ["w"], "world": world}
    settings = {} if enabled == "auto" else {"refine_poses": {"enabled": enabled}}
    assert refines_poses(load({"datasets": {"w": dataset}, **settings}), "w") is refined


@pytest.mark.parametrize(
    ("settings", "taken"),
    [
        ({}, []),
        (REFINED, ["elsewhere/a1/triangulated.npz"]),
        ({**REFINED, "lidar_seed": {"triangulated": False}}, []),
        ({"lidar_seed": {"triangulated": True}}, []),
    ],
)
def test_triangulated_points_are_an_input_of_the_seed_where_there_are_any_and_they_are_wanted(settings, taken):
    assert plan(**settings).triangulated(SimpleNamespace(scene="a1")) == taken


@pytest.mark.parametrize(
    ("settings", "estimated"),
    [({"start": "images"}, True), ({"enabled": False, "start": "images"}, False), ({}, False)],
)
def test_the_extraction_knows_whether_poses_are_estimated_where_drives_may_lack_them(settings, estimated):
    mine = {"datasets": {"mine": {"reader": "drive", "dataroot": "d", "scenes": ["it"]}}, "refine_poses": settings}
    assert json.loads(stage_settings(load(mine), "extract", "it"))["poses_from_images"] is estimated
    assert stage_record("extract", refine_poses=settings)["poses_from_images"] is False, "nuScenes has poses"


def stage_record(stage: str, **values: Any) -> dict[str, Any]:
    return json.loads(stage_settings(load(values), stage, "0061"))


def test_each_stage_gets_the_settings_that_determine_it():
    values = {
        "actors": {"humans": True}, "holdout": {"last_block": 2}, "images": {"width": 320}, "random_seed": 7,
        "lidar_seed": {"own_car_radius": 3.0, "box_margin": 0.3}, "lidar_depth": {"ray_spacing": [0.2, 0.4]},
    }  # fmt: skip
    job = stage_record("refine_poses", random_seed=3, refine_poses={"rounds": 5})
    assert job.keys() == {"refine_poses", "random_seed", "lidar"} and job["lidar"]["own_car_radius"] == 2.5
    assert (job["refine_poses"]["rounds"], job["random_seed"]) == (5, 3)
    alone = stage_record("refine_poses", refine_poses={"start": "images"}, **values)
    assert alone["lidar"] == {"ray_spacing": [0.2, 0.4], "own_car_radius": 3.0}
    actors, depth = (stage_record(stage, **values) for stage in ("actors", "lidar_depth"))
    for record in (actors, depth):
        assert (record["holdout"]["last_block"], record["images"]["width"], record["own_car_radius"]) == (2, 320, 3.0)
    assert (actors["actors"]["humans"], actors["random_seed"]) == (True, 7)
    assert depth["box_margin"] == 0.3 and "actors" not in depth and "random_seed" not in depth
    assert depth["ray_spacing"] == [0.2, 0.4] and stage_record("evaluate", **values)["lidar"] == depth


def test_figures_come_from_all_stages_but_the_one_that_puts_them_side_by_side():
    made = plan(methods={"vanilla": {}, "mine": {"parts": ACTORS}})
    of_scene = {*SCENE_STAGES} - {"scene_metrics"}
    assert made.evaluation_stages("a1", ["vanilla"]).keys() == {*of_scene, "vanilla/train", "vanilla/evaluate"}
    assert made.evaluation_stages("a1", ["mine"]).keys() == {*of_scene, "actors", "mine/train", "mine/evaluate"}


def test_films_of_the_recorded_path_share_its_frames_where_the_settings_say_so():
    """Those of methods that can be edited."""
    trajectories = {"original": {}, "aside": {"lateral": 2.0}, "objects": {"parts": "moving"}}
    render = {"recorded_once": True, "trajectories": trajectories}
    made = plan(methods={"vanilla": {}, "mine": {"parts": ACTORS}}, render=render)

    def shared(method: str, **film: str) -> list[str]:
        return made.recorded_frames(SimpleNamespace(scene="a1", method=method, **film))

    expected = ["elsewhere/a1/mine/recorded_frames.npy"]
    assert shared("mine") == shared("mine", edit="new") == shared("mine", trajectory="original") == expected
    assert shared("mine", trajectory="aside") == shared("mine", trajectory="objects") == shared("vanilla") == []
    made = plan(methods={"mine": {"parts": ACTORS}}, render={"trajectories": trajectories})
    assert shared("mine") == shared("mine", trajectory="original") == []


def test_methods_with_lidar_are_told_without_configs_of_methods_that_do_not_run():
    made = plan(methods={f"scans{number}": {"overrides": LIDAR} for number in range(3)})
    before = len(made.config.places)
    assert {"scans0", "scans1", "scans2"} <= {*made.methods_with_lidar_in_any_scene}
    assert all(method is None for _, method in [*made.config.places][before:])


def test_pictures_and_films_of_scans_are_those_of_methods_that_render_lidar():
    """By the settings of the method, and of the dataset. Films that are left out can be asked for by name, too."""
    methods = {"vanilla": {}, "street": None, "scans": {"overrides": LIDAR}}
    made = plan(methods=methods, b={**LIDAR, "render": {"lidar": False}})
    assert made.methods_with_lidar_in_any_scene == ["vanilla", "scans"]

    def of_lidar(files: list[str]) -> set[str]:
        return {path.removeprefix("elsewhere/") for path in files if "lidar" in path}

    pictures = {f"{folder}/lidar.png" for folder in ("a1/scans", "a2/scans", "b1/scans", "b1/vanilla")}
    assert of_lidar(made.looks()) == of_lidar(made.report([]).pictures()) == pictures
    films = {"a1/scans/lidar.mp4", "a2/scans/lidar.mp4"}
    assert of_lidar(made.films()) == films <= of_lidar(made.report([]).links())
    more = ("b1/vanilla/lidar.png", "b1/scans/lidar.mp4", "b1/scans/lidar.json")
    made.refuse_unknown([f"elsewhere/{name}" for name in (*pictures, *films, *more)])
    for kind in ("png", "mp4"):
        with pytest.raises(ConfigError, match=r"method 'vanilla' renders no LiDAR of scene a1 .* those do: scans \("):
            made.refuse_unknown([f"elsewhere/a1/vanilla/lidar.{kind}"])
    with pytest.raises(ConfigError, match=r"those do: none \(docs/lidar\.md; presets/lidar\.yaml"):
        plan(methods={"vanilla": {}}).refuse_unknown(["elsewhere/a1/vanilla/lidar.mp4"])


@pytest.fixture
def with_edit(tmp_path) -> dict[str, Any]:
    """Scene a1, which has an edit."""
    (tmp_path / "edits.yaml").write_text("edits: {gone: [remove: {track: a}]}")
    dataset = {"scenes": ["a1"], "edits": {"a1": str(tmp_path / "edits.yaml")}}
    return {"datasets": {"a": dataset}, "render": {"trajectories": {"original": {}, "objects": {"parts": "moving"}}}}


def test_a_method_that_moves_without_objects_has_films_of_its_parts_but_no_actors_and_no_edits(with_edit):
    made = plan(**with_edit, methods={"drifting": {"parts": DRIFTING}, "mine": {"parts": ACTORS}})
    assert {path.split("/", 2)[2] for path in made.films()} >= {"drifting/objects.mp4", "drifting/parts.mp4"}
    assert taken(made, "a1", "drifting") == []
    assert made.edits() == ["elsewhere/a1/mine/edits/gone.mp4"]
    made.refuse_unknown(["elsewhere/a1/drifting/parts.mp4", "elsewhere/a1/drifting/objects.mp4"])
    with pytest.raises(ConfigError, match=r"'drifting' knows no actors that could be edited; those do: mine"):
        made.refuse_unknown(["elsewhere/a1/drifting/edits/gone.mp4"])
    pages = {name: json.loads(made.stage_settings("export_viewer", "a1", name)) for name in ("drifting", "mine")}
    assert not pages["drifting"]["edits"] and list(pages["mine"]["edits"]) == ["gone"]


def test_an_edit_that_inserts_assets_waits_for_them_and_for_the_light_of_its_scene(tmp_path):
    def inserted(*names: str, **wildcards: str | None) -> list[str]:
        steps = ", ".join(f"insert: {{asset: {name}, as: it{i}, at: [9, 0]}}" for i, name in enumerate(names))
        (tmp_path / "edits.yaml").write_text(f"edits: {{new: [{steps}], gone: [remove: {{track: x}}]}}")
        dataset = {"scenes": ["a1", "b1"], "edits": {"a1": str(tmp_path / "edits.yaml")}}
        made = plan(datasets={"a": dataset}, methods={"mine": {"parts": ACTORS}, "other": {"parts": ACTORS}})
        files = made.inserts(SimpleNamespace(**{"scene": "a1", "method": "mine", "edit": "new", **wildcards}))
        return [file.removeprefix("elsewhere/") for file in files]

    assert inserted("b1/7f") == ["b1/mine/assets/assets.json", "a1/light.json"]
    own = ["own/asset.json", "own/asset.ply"]
    assert inserted("b1/other/7f", "./own") == ["b1/other/assets/assets.json", *own, "a1/light.json"]
    assert inserted("b1/7f", edit="gone") == []
    assert inserted("b1/7f", edit=None, kind="edits", drive="new") == ["b1/mine/assets/assets.json", "a1/light.json"]
    assert inserted("b1/7f", edit=None, kind="trajectories", drive="new") == []
    with pytest.raises(ConfigError, match=r"edit 'new' inserts asset 'c9/7f', and the config has no scene 'c9'"):
        inserted("c9/7f")
    with pytest.raises(ConfigError, match=r"edit 'new' inserts asset 'b1/vanilla/7f'; methods with assets are: .*mine"):
        inserted("b1/vanilla/7f")
    with pytest.raises(ConfigError, match=r"asset 'alone' is neither \{scene\}/\{track\} nor"):
        inserted("alone")


def test_assets_are_those_of_methods_that_can_be_edited(with_edit):
    made = plan(**with_edit)
    assert [path for path in made.assets() if "/a1/" in path] == ["elsewhere/a1/street/assets/assets.json"]


def test_drive_folders_are_of_edits_and_of_trajectories_that_show_everything(with_edit):
    made = plan(**with_edit)
    assert {path.split("/", 1)[1] for path in made.drives() if "/a1/" in path} == {
        "a1/street/edits/gone/drive/drive.json",
        "a1/street/trajectories/original/drive/drive.json",
        "a1/vanilla/trajectories/original/drive/drive.json",
    }
    made.refuse_unknown(made.drives())
    for target, message in {
        "street/trajectories/objects/drive/drive.json": "shows the moving parts alone",
        "street/trajectories/nowhere/drive/drive.json": "no film called 'nowhere'",
        "vanilla/truth.mp4": r"truth\.mp4 needs the truth of a synthetic world, and scene a1 is none",
        "street/edits/gone/drive": "ask for the file elsewhere/a1/street/edits/gone/drive/drive.json",
    }.items():
        with pytest.raises(ConfigError, match=message):
            made.refuse_unknown([f"elsewhere/a1/{target}"])


def test_mcap_files_are_of_the_recorded_path_and_of_edits_with_scans_where_there_are_some(with_edit):
    made = plan(**with_edit, methods={"vanilla": {}, "moving": {"parts": ACTORS, "overrides": LIDAR}})
    wanted = {path.split("/", 1)[1] for path in made.mcap_files() if "/a1/" in path}
    assert wanted == {"a1/moving/drive.mcap", "a1/moving/edits/gone/drive.mcap", "a1/vanilla/drive.mcap"}
    made.refuse_unknown([*made.mcap_files(), "elsewhere/a1/vanilla/trajectories/original/drive.mcap"])

    def inputs(method: str, at: str) -> list[str]:
        job = SimpleNamespace(scene="a1", method=method, at=at)
        return [path.removeprefix("elsewhere/a1/") for path in (made.drive_of_mcap(job), *made.scans_of_mcap(job))]

    original, gone = "moving/trajectories/original", "moving/edits/gone"
    assert inputs("moving", "") == [f"{original}/drive/drive.json", f"{original}/scans/scans.json"]
    assert inputs("moving", "edits/gone/") == [f"{gone}/drive/drive.json", f"{gone}/scans/scans.json"]
    assert inputs("moving", "runs/fast/") == ["moving/runs/fast/drive/drive.json"]
    assert inputs("vanilla", "") == ["vanilla/trajectories/original/drive/drive.json"]
    for target, message in {
        "moving/edits/halt/drive.mcap": "no edit called 'halt'",
        "vanilla/edits/gone/drive.mcap": "'vanilla' knows no actors",
        "moving/trajectories/nowhere/drive.mcap": "no film called 'nowhere'",
        "moving/trajectories/objects/drive.mcap": "shows the moving parts alone",
    }.items():
        with pytest.raises(ConfigError, match=message):
            made.refuse_unknown([f"elsewhere/a1/{target}"])


def test_scans_are_of_edits_and_trajectories_of_methods_that_render_lidar(with_edit):
    lidar = {"overrides": LIDAR}
    made = plan(**with_edit, methods={"vanilla": {}, "static": lidar, "moving": {"parts": ACTORS, **lidar}})
    made.refuse_unknown([
        "elsewhere/a1/moving/edits/gone/scans/scans.json",
        "elsewhere/a1/static/trajectories/original/scans/scans.json",
    ])  # fmt: skip
    for target, message in {
        "vanilla/trajectories/original/scans/scans.json": "'vanilla' does not render LiDAR.* those do: static, moving",
        "static/edits/gone/scans/scans.json": "'static' knows no actors",
        "moving/edits/halt/scans/scans.json": "no edit called 'halt'",
        "moving/trajectories/objects/scans/scans.json": "shows the moving parts alone",
        "moving/edits/gone/scans": "ask for the file elsewhere/a1/moving/edits/gone/scans/scans.json",
    }.items():
        with pytest.raises(ConfigError, match=message) as refused:
            made.refuse_unknown([f"elsewhere/a1/{target}"])
        assert "\n" not in str(refused.value)


# ---- the report across scenes


@pytest.mark.parametrize(
    ("targets", "scenes", "seen", "wanted"),
    [
        ([], 3, True, True),
        (["all"], 3, True, True),
        (["metrics"], 3, False, False),
        (["report"], 0, False, True),
        (["gap_report", "elsewhere/gap_report.html"], 0, False, True),
        (["elsewhere/gap_report.csv", "metrics"], 3, False, True),
        (["elsewhere/a1/metrics.json"], 3, False, False),
    ],
)
def test_a_report_waits_for_what_is_asked_for_with_it(targets, scenes, seen, wanted):
    report = plan().report(targets)
    assert len(report.metrics()) == scenes and report.wanted == wanted
    assert len(report.pictures()) == 2 * scenes * (len(PICTURES) - len(LIDAR_LOOKS) if seen else len(HELD_OUT_PAIR))
    assert bool(report.links()) == seen


def test_a_report_asked_for_alone_is_of_what_is_there(tmp_path):
    made = plan(results_dir=str(tmp_path))
    there = ["b1/metrics.json", "b1/street/original.mp4", "b1/street/held_out_recorded.png", "b1/street/with_car.png"]
    for name in (*there, "a1/vanilla/viewer.html"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    report = made.report(["report"])
    found = [*report.metrics(), *report.links(), *report.pictures()]
    assert found == [str(tmp_path / name) for name in there]
    assert {Path(link).name for link in made.report([]).links()} >= {"original.mp4", "parts.mp4", "viewer.html"}


def test_a_report_has_the_runs_that_are_asked_for_with_it(tmp_path):
    runs = tmp_path / "runs.yaml"
    runs.write_text("runs: {fast: {policy: constant_speed}, slow: {policy: recorded}}")
    made = plan(runs=str(runs))
    every, one = made.runs(), "elsewhere/a1/street/runs/fast.json"
    for targets, wanted in ((["runs", "report"], every), ([one, "report"], [one]), (["metrics", "report"], [])):
        assert made.report(targets).runs() == wanted


def test_what_only_the_report_knows():
    """The reference is the first static method; a change of published figures reruns the report alone."""
    figures = {"source": "S", "url": "https://example.org", "scene": "a1", "method": "M", "psnr": 20.0}
    before, after = (json.loads(plan(**more).report([]).settings()) for more in ({}, {"published": [figures]}))
    assert before.pop("published") == [] and before == {name: after[name] for name in before}
    assert after["published"][0].items() >= figures.items()
    moving = {"vanilla": None, "street": None, "moves": {"parts": ACTORS}}
    for methods, reference in (({**moving, "b": {}, "c": {}}, "b"), (moving, None)):
        assert json.loads(plan(methods=methods).report([]).settings())["reference"] == reference


def test_a_report_asked_for_by_itself_is_not_made_empty_where_other_scenes_have_been_measured(tmp_path):
    """As after the demo: its report would give way to one of nothing."""
    datasets = {"a": {"scenes": ["a1"]}, "demo": {"scenes": ["demo"], "batch": False}}
    made = Plan({"datasets": datasets, "results_dir": str(tmp_path)}, str(REPOSITORY))
    made.report(["report"]).refuse_empty()
    for scene in ("demo", "a1"):
        (tmp_path / scene).mkdir()
    (tmp_path / "demo/metrics.json").touch()
    for targets in (["report"], [f"{tmp_path}/gap_report.html"]):
        with pytest.raises(ConfigError, match=r"demo has, .*--configfile presets/demo\.yaml"):
            made.report(targets).refuse_empty()
    for others in ([], ["all"], ["report", "metrics"]):
        made.report(others).refuse_empty()
    (tmp_path / "a1/metrics.json").touch()
    made.report(["report"]).refuse_empty()


def test_a_dataset_that_moves_keeps_its_root_in_results(tiny_root, tmp_path, monkeypatch):
    """However its path is written; the link there leads to where it is."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny_root, "data")
    at, link = SimpleNamespace(scene="0001"), Path("out/.data/tiny")

    def root(dataroot: str) -> str:
        datasets = {"tiny": {"dataroot": dataroot, "scenes": ["0001"]}}
        return Plan({"datasets": datasets, "results_dir": "out"}, str(REPOSITORY)).root(at)

    assert root("data") == root("./data/") == root(str(tmp_path / "data")) == root("data/v1.0-mini") == str(link)
    assert link.resolve() == tmp_path / "data"
    Path("data").rename("moved")
    assert root("moved") == str(link) and link.resolve() == tmp_path / "moved"
    monkeypatch.setattr(Path, "symlink_to", lambda *_: (_ for _ in ()).throw(OSError("no links here")))
    link.unlink()
    assert root("moved") == "moved", "on a disk without links"


# ---- cameras


def test_a_camera_that_a_dataset_lacks_is_refused_with_those_there_are(tiny_root, tmp_path):
    """Before any job: of recorded datasets by their tables, of worlds by their settings."""
    data = {"tiny": {"dataroot": str(tiny_root), "scenes": ["0001"]}}
    made = Plan(
        {"datasets": data, "cameras": ["CAM_FRONT", "CAM_BACKK"], "results_dir": str(tmp_path)}, str(REPOSITORY)
    )
    with pytest.raises(ConfigError, match=r"dataset tiny has no camera 'CAM_BACKK' .*there are: CAM_FRONT"):
        made.refuse_absent_data([f"{tmp_path}/0001/metrics.json"])
    world = {"w": {"dataroot": "resources/w", "scenes": ["w"], "world": {"cameras": ["CAM_FRONT"]}}}
    made = Plan({"datasets": world, "cameras": ["CAM_FRONT", "CAM_BACK"]}, str(REPOSITORY))
    with pytest.raises(ConfigError, match=r"dataset w has no camera 'CAM_BACK' .*there are: CAM_FRONT"):
        made.refuse_absent_data(["results/w/metrics.json"])


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (os.mkfifo, "it is a pipe, not a regular file"), (os.mkdir, "it is a folder, not a regular file"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
    ],
)  # fmt: skip
def test_a_points_file_that_is_a_pipe_or_a_folder_is_refused(tiny_root, tmp_path, make, what):
    """A job would wait for the pipe's other end, and Snakemake takes a circle of links for a file."""
    make(tmp_path / "points.ply")
    data = {"tiny": {"dataroot": str(tiny_root), "scenes": ["0001"]}}
    seed = {"points_file": str(tmp_path / "points.ply")}
    made = Plan({"datasets": data, "results_dir": str(tmp_path / "out"), "lidar_seed": seed}, str(REPOSITORY))
    with pytest.raises(ConfigError, match=rf"points_file .*/points\.ply: {what}; name a PLY file of points"):
        made.refuse_absent_data([f"{tmp_path}/out/0001/metrics.json"])


# ---- targets


EVERY_METHOD = ("", "street", "vanilla")


@pytest.mark.parametrize(
    ("targets", "scenes", "methods"),
    [
        ([], ("a1", "a2", "b1"), EVERY_METHOD),
        (["films"], ("a1", "a2", "b1"), EVERY_METHOD),
        (["elsewhere/gap_report.html"], ("a1", "a2", "b1"), EVERY_METHOD),
        (["elsewhere/a2/metrics.json"], ("a2",), EVERY_METHOD),
        (["elsewhere/a2/street/original.mp4"], ("a2",), ("", "street")),
        (["elsewhere/a1/seed.ply", "elsewhere/b1/masks/masks.json"], ("a1", "b1"), ("",)),
        (["download_nuscenes_mini"], (), EVERY_METHOD),
    ],
)
def test_targets_concern_these_scenes_and_methods(targets, scenes, methods):
    expected = {(scene, method) for scene in scenes for method in methods}
    assert plan().scenes_and_methods(targets) == expected
