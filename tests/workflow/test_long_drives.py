"""Planning of drives that are cut into blocks: names, settings, files, and what is refused in one sentence."""

import json
from types import SimpleNamespace

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.blocks import drive_of
from drivesplat.settings.config import for_scene
from drivesplat.workflow.long_drives import (
    LongDrives,
    chosen_lengths,
    refuse_results_of_blocks,
    require_cameras,
    require_left_out,
    targets_without_drives,
)
from drivesplat.workflow.named_tracks import track_references
from drivesplat.workflow.plan import Plan

BLOCKS = {"length_m": 100.0, "overlap_m": 10.0}
CUT = {"reader": "drive", "scenes": ["way"], "blocks": BLOCKS, "overrides": {"train": {"iterations": 77}}}


def plan(**datasets) -> Plan:
    named = {"whole": {"scenes": ["0001"]}, "cut": CUT, **datasets}
    return Plan({"datasets": named, "methods": {"vanilla": {}}, "results_dir": "there"}, str(REPOSITORY))


@pytest.fixture
def drives(tmp_path) -> LongDrives:
    path = tmp_path / "blocks.json"
    path.write_text(json.dumps({"blocks": [{"digest": "a"}, {"digest": "b"}]}))
    return LongDrives(plan(), {"way": str(path)}.__getitem__)


def at(scene: str, method: str = "vanilla") -> SimpleNamespace:
    return SimpleNamespace(scene=scene, method=method)


def test_a_block_has_the_settings_and_the_methods_of_its_drive():
    made = plan()
    assert made.config.is_block("way.003") and made.config.is_cut("way") and not made.config.is_cut("way.003")
    assert not made.config.is_block("0001.003"), "that drive is not cut"
    of_drive, of_block = (json.loads(made.stage_settings("train", name, "vanilla")) for name in ("way", "way.003"))
    assert of_block == of_drive and of_block["train"]["iterations"] == 77
    assert json.loads(made.stage_settings("block", "way.003"))["blocks"]["length_m"] == 100.0
    assert made.annotated_scene(at("way.003")) == "there/way.003/scene.json", "its poses are those of the drive"
    assert made.truth(at("way.003")) == []


def test_the_drive_has_films_and_figures_and_its_blocks_all_else():
    made = plan()
    assert made.metrics() == ["there/0001/metrics.json", "there/way/metrics.json"]
    of_drive = {path for path in (*made.films(), *made.exports(), *made.looks(), *made.drives()) if "/way/" in path}
    films = for_scene(made.config, "way").render.trajectories.items()
    whole = [f"{name}.mp4" for name, film in films if film.parts == "all"]
    assert whole and of_drive == {f"there/way/vanilla/{name}" for name in (*whole, "splats/splats.json")}
    stages = made.metrics_stages("way")
    assert {"block", "vanilla/evaluate_blocks", "vanilla/train"} <= stages.keys()
    assert not {"block", "vanilla/evaluate_blocks"} & made.metrics_stages("0001").keys()


def test_the_files_of_blocks_follow_from_the_record_of_the_drive(drives):
    assert drives.inputs_of_block(at("way.001"))[0] == "there/way/scene_refined.json"
    assert (drives.digest(at("way.000")), drives.digest(at("way.001"))) == ("a", "b")
    results = drives.results("{method}/eval.json")(at("way"))
    assert results == ["there/way.000/vanilla/eval.json", "there/way.001/vanilla/eval.json"]
    assert drives.each(plan().scene)(at("way")) == ["there/way.000/scene.json", "there/way.001/scene.json"]
    with pytest.raises(ConfigError, match=r"scene way has no block called way.002; it has 2: way.000 to way.001"):
        drives.inputs_of_block(at("way.002"))
    with pytest.raises(ConfigError, match=r"scene way has no block called way.0001; it has 2"):
        drives.inputs_of_block(at("way.0001"))


def starts(tmp_path, **blocks) -> list[list[str]]:
    """What the trainings of five blocks start from: block 4 is reached from block 1, and block 3 behind a jump."""
    path = tmp_path / "blocks.json"
    before = [None, 0, 1, None, 1]
    path.write_text(json.dumps({"blocks": [{"digest": str(i), "previous": own} for i, own in enumerate(before)]}))
    made = plan(cut={**CUT, "blocks": {**BLOCKS, **blocks}})
    drives = LongDrives(made, {"way": str(path)}.__getitem__)
    assert drives.previous(at("0001")) == drives.previous_parser(at("0001")) == []
    found = [(drives.previous(at(f"way.00{i}")), drives.previous_parser(at(f"way.00{i}"))) for i in range(5)]
    assert all(len(checkpoint) == len(parser) for checkpoint, parser in found)
    return [[*checkpoint, *parser] for checkpoint, parser in found]


def test_blocks_start_from_the_block_that_the_vehicle_comes_from(tmp_path):
    assert starts(tmp_path) == [[]] * 5, "by default each is trained alone"
    of = {i: [f"there/way.00{i}/vanilla/checkpoint.npz", f"there/way.00{i}/parser.npz"] for i in range(5)}
    assert starts(tmp_path, init="previous") == [[], of[0], of[1], [], of[1]]
    assert starts(tmp_path, init="previous", leave_out=[1]) == [[], of[0], [], [], []]
    settings = [plan(cut={**CUT, "blocks": {**BLOCKS, "init": init}}) for init in ("alone", "previous")]
    for stage in ("blocks", "block", "evaluate_blocks", "train"):
        before, after = (made.stage_settings(stage, "way.001", "vanilla") for made in settings)
        assert before == after, "blocks without one before them keep their training"


@pytest.mark.parametrize(
    "path", [["masks", "masks.json"], ["vanilla", "splat.ply"], ["vanilla", "edits", "gone.mp4"], ["seed.ply"]]
)
def test_results_of_blocks_are_refused_for_a_drive(path):
    with pytest.raises(ConfigError, match=f"scene way is cut into blocks.*ask for there/way.000/{'/'.join(path)}"):
        refuse_results_of_blocks(plan().config, "way", path)


def test_results_of_a_drive_and_those_of_other_scenes_are_not_refused():
    config = plan().config
    of_method = [["vanilla", name] for name in ("eval.json", "original.mp4", "scene.usd", "viewer.html")]
    for path in (["metrics.json"], ["blocks.json"], *of_method):
        refuse_results_of_blocks(config, "way", path)
    refuse_results_of_blocks(config, "0001", ["vanilla", "splat.ply"])
    refuse_results_of_blocks(config, "way.000", ["vanilla", "splat.ply"])


def test_results_of_a_drive_are_refused_for_a_block_and_blocks_without_cameras():
    with pytest.raises(ConfigError, match=r"poses.json is a result of the whole drive: ask for there/way/poses.json"):
        refuse_results_of_blocks(plan().config, "way.000", ["poses.json"])
    alone = plan(cut={**CUT, "overrides": {"cameras": [], "eval_camera": None}}).config
    with pytest.raises(ConfigError, match=r"scene way has no camera .* leave out blocks"):
        require_cameras(alone, "way")
    require_cameras(plan().config, "way")


def test_a_scene_with_the_name_of_a_block_is_refused():
    with pytest.raises(ConfigError, match=r"scene 'way\.007' has the name of a block of scene 'way'; rename it"):
        plan(other={"scenes": ["way.007"]})
    with pytest.raises(ConfigError, match=r"scene 'way\.001' has the name of a block of scene 'way'; rename it"):
        plan(cut={**CUT, "scenes": ["way", drive_of("way") + ".001"]})


@pytest.mark.parametrize(
    ("target", "little", "example"),
    [
        ("edits", "nothing", "street/edits/NAME.mp4"),
        ("drives", "nothing", "street/edits/NAME/drive/drive.json"),
        ("assets", "nothing", "street/assets/assets.json"),
        ("runs", "nothing", "street/runs/NAME.json"),
        ("mcap", "nothing", "street/drive.mcap"),
        ("looks", "nothing", "street/removal.png"),
        ("alpasim", "nothing", "street/scene.alpasim.usdz"),
        ("exports", "splats alone", "street/viewer.html"),
    ],
)
def test_targets_that_make_nothing_of_a_drive_say_what_there_is(target, little, example):
    methods = {"vanilla": {}, "street": {"parts": ["background", "actors"]}}
    made = Plan({"datasets": {"cut": CUT}, "methods": methods, "results_dir": "there"}, str(REPOSITORY))
    (sentence,) = targets_without_drives(made, [target, "metrics"])
    assert f"scene way is cut into blocks: {target} makes {little} of it; ask for files of blocks, " in sentence
    assert f" as there/way.000/{example}; its blocks are way.000 and so on, and of the whole" in sentence
    assert "metrics.json, index.html and, of each method, original.mp4" in sentence
    assert sentence.endswith("splats/splats.json (docs/long_drives.md)")


def test_targets_of_drives_and_other_scenes_say_nothing():
    assert targets_without_drives(plan(), ["metrics", "films", "report", "there/way/metrics.json"]) == []
    whole = Plan({"datasets": {"whole": {"scenes": ["0001"]}}, "methods": {"vanilla": {}}}, str(REPOSITORY))
    assert targets_without_drives(whole, ["edits", "runs", "alpasim"]) == []


def test_the_blocks_of_a_drive_are_named_where_they_are_known(tmp_path):
    (tmp_path / "way").mkdir()
    (tmp_path / "way/blocks.json").write_text(json.dumps({"blocks": [{}] * 12}))
    config = Plan({"datasets": {"cut": CUT}, "results_dir": str(tmp_path)}, str(REPOSITORY)).config
    with pytest.raises(ConfigError, match=r"its blocks are way.000 to way.011, and of the whole drive there are"):
        refuse_results_of_blocks(config, "way", ["street", "assets", "assets.json"])


def test_edits_and_runs_of_blocks_are_made_with_those_of_other_scenes(tmp_path):
    edits, runs = tmp_path / "edits.yaml", tmp_path / "runs.yaml"
    edits.write_text("edits: {gone: [{remove: {track: abc}}]}")
    runs.write_text(
        "runs: {everywhere: {policy: recorded}, here: {policy: recorded, scenes: [way.001]}, "
        "changed: {policy: recorded, edit: gone}}"
    )
    methods = {"street": {"parts": ["background", "actors"]}}
    cut = {**CUT, "edits": {"way.003": str(edits)}}
    settings = {"methods": methods, "runs": str(runs), "results_dir": "there"}
    made = Plan({"datasets": {"cut": cut}, **settings}, str(REPOSITORY))
    assert made.edits() == ["there/way.003/street/edits/gone.mp4"]
    assert made.runs() == ["there/way.003/street/runs/changed.json", "there/way.001/street/runs/here.json"]
    assert targets_without_drives(made, ["edits", "runs"]) == []
    assert made.edits(scenes=[]) == []
    runs.write_text("runs: {here: {policy: recorded, scenes: [way]}}")
    with pytest.raises(ConfigError, match=r"run 'here': scene way is cut into blocks, .* such as way.000"):
        made.runs()


def edited(tmp_path, text: str, **methods) -> Plan:
    """A drive that is cut into blocks with an edits file."""
    file = tmp_path / "edits.yaml"
    file.write_text(f"edits: {text}")
    every = {"vanilla": {}, "street": {"parts": ["background", "actors"]}, **methods}
    cut = {**CUT, "edits": {"way": str(file)}}
    return Plan({"datasets": {"cut": cut}, "methods": every, "results_dir": "there"}, str(REPOSITORY))


def test_edits_of_a_whole_drive_are_made_by_methods_whose_objects_have_one_id_in_all_blocks(tmp_path):
    found = {"parts": ["background", "actors"], "tracks": "discovered"}
    made = edited(tmp_path, "{gone: [{remove: {track: abc}}]}", found=found)
    assert made.edits() == ["there/way/street/edits/gone.mp4"] and targets_without_drives(made, ["edits"]) == []
    for name in ("gone.mp4", "gone.png", "gone.json"):
        made.refuse_unknown([f"there/way/street/edits/{name}"])
    settings = json.loads(made.stage_settings("edit_blocks", "way", "street", "gone"))
    assert settings["edit"] == {"steps": [{"remove": {"track": "abc"}}]} and settings["left_out"] == []
    with pytest.raises(ConfigError, match=r"in each of which 'found' finds its own objects: edit a block \(way.000\)"):
        made.refuse_unknown(["there/way/found/edits/gone.mp4"])
    with pytest.raises(ConfigError, match="scene way has no edit called 'moved'; there are: gone"):
        made.refuse_unknown(["there/way/street/edits/moved.mp4"])
    drive = r"gone/drive/drive.json is a result of one block.* edits/NAME.mp4, scene.usd, viewer.html and splats"
    with pytest.raises(ConfigError, match=drive):
        made.refuse_unknown(["there/way/street/edits/gone/drive/drive.json"])
    assert track_references(made.config, "way").edits[0].track == "abc", "`extract` looks for it"


def test_assets_are_inserted_into_blocks_alone(tmp_path):
    with pytest.raises(ConfigError, match=r"edit 'new' inserts an asset, and scene way is cut into blocks: .* way.000"):
        edited(tmp_path, "{new: [{insert: {asset: 0061/abc, as: other, at: [10, 0]}}]}").edits()


def test_blocks_are_left_out_of_the_results_of_the_drive_alone(drives, tmp_path):
    blocks = tmp_path / "blocks.json"

    def left_out(*numbers) -> LongDrives:
        made = plan(cut={**CUT, "blocks": {**BLOCKS, "leave_out": numbers}})
        return LongDrives(made, lambda _: str(blocks))

    evals = "{method}/eval.json"
    assert left_out(0).results(evals)(at("way")) == left_out("way.000").results(evals)(at("way"))
    assert left_out(0).results(evals)(at("way")) == ["there/way.001/vanilla/eval.json"]
    with pytest.raises(ConfigError, match=r"blocks.leave_out names block 2 of scene way, which has 2, counted from 0"):
        left_out(2).results(evals)(at("way"))
    with pytest.raises(ConfigError, match=r"blocks.leave_out leaves no block of scene way, which has 2; keep one"):
        left_out(0, 1).results(evals)(at("way"))
    stages = ("blocks", "block", "train", "evaluate", "evaluate_blocks", "export_blocks", "usd_blocks", "film_blocks")
    one, other = plan(), plan(cut={**CUT, "blocks": {**BLOCKS, "leave_out": [1]}})
    films = {"film_blocks": "original"}
    changed = [
        stage
        for stage in stages
        if one.stage_settings(stage, "way", "vanilla", films.get(stage))
        != other.stage_settings(stage, "way", "vanilla", films.get(stage))
    ]
    assert changed == ["evaluate_blocks", "export_blocks", "usd_blocks", "film_blocks"]


def test_blocks_that_are_known_to_be_absent_are_refused_before_anything_runs(tmp_path):
    (tmp_path / "way").mkdir()
    cut = {**CUT, "blocks": {**BLOCKS, "leave_out": [0, 4]}}
    config = Plan({"datasets": {"cut": cut}, "results_dir": str(tmp_path)}, str(REPOSITORY)).config
    require_left_out(config, "way")
    blocks = tmp_path / "way/blocks.json"
    blocks.write_text(json.dumps({"blocks": [{}] * 5}))
    require_left_out(config, "way")
    blocks.write_text(json.dumps({"blocks": [{}] * 4}))
    with pytest.raises(ConfigError, match=r"blocks.leave_out names block 4 of scene way, which has 4"):
        require_left_out(config, "way")


@pytest.mark.parametrize(
    ("scenes", "leave_out", "message"),
    [
        (["way"], ["other.003"], r"leave_out names 'other.003', which is no block of any of its scenes; .* way.003"),
        (["way"], ["way"], r"leave_out names 'way', which is no block"),
        (["way", "back"], [3], r'names block 3, and there are 2 scenes: name the block, such as "way.003"'),
        (["way"], [-1], r"-1 is no number of a block; they are counted from 0"),
        (["0001"], [1.003], r"1.003 is a number to YAML: write the name of a block in quotes"),
    ],
)
def test_what_is_no_block_of_the_dataset_cannot_be_left_out(scenes, leave_out, message):
    with pytest.raises(ConfigError, match=message):
        plan(whole={"scenes": ["whole"]}, cut={**CUT, "scenes": scenes, "blocks": {**BLOCKS, "leave_out": leave_out}})


def test_of_several_drives_each_leaves_out_its_own_blocks():
    named = {**BLOCKS, "leave_out": ["way.001", "back.000"]}
    made = plan(cut={**CUT, "scenes": ["way", "back"], "blocks": named})
    jobs = [json.loads(made.stage_settings("evaluate_blocks", scene, "vanilla")) for scene in ("way", "back")]
    assert [job["left_out"] for job in jobs] == [[1], [0]]


def test_nothing_of_a_drive_is_made_from_all_of_its_scans():
    scans = {"overrides": {"train": {"scans": {"per_image": 0.25}}}}
    names = {"vanilla": {}, "found": {"parts": ["background", "actors"], "tracks": "discovered", **scans}}
    made = Plan({"datasets": {"cut": CUT}, "methods": names, "results_dir": "there"}, str(REPOSITORY))
    assert made.scan_baselines(at("way")) == made.discovered(at("way", "found")) == []
    assert made.scan_baselines(at("way.000")) == ["there/way.000/scan_baselines.json"]
    assert made.discovered(at("way.000", "found")) == ["there/way.000/discovered.json"]
    assert not {"scan_baselines"} & made.metrics_stages("way").keys()


def auto(results: str = "there", **blocks) -> Plan:
    cut = {**CUT, "blocks": {"length_m": "auto", **blocks}}
    return Plan({"datasets": {"cut": cut}, "methods": {"vanilla": {}}, "results_dir": results}, str(REPOSITORY))


def test_what_the_length_is_chosen_by_concerns_the_cut_alone_and_no_machine():
    def settings(made: Plan, stage: str) -> dict:
        return json.loads(made.stage_settings(stage, "way", "vanilla"))

    assert settings(auto(), "blocks")["card"] == {"memory_gb": 8.0, "gaussians": 1_500_000, "width": None}
    assert settings(auto(memory_gb=24), "blocks")["card"]["memory_gb"] == 24.0
    assert settings(plan(), "blocks")["card"] is None, "a length in metres does not depend on it"
    for stage in ("block", "train", "evaluate"):
        assert settings(auto(), stage) == settings(auto(memory_gb=24), stage)
    cut = {**CUT, "blocks": {"length_m": "auto"}, "overrides": {"images": {"width": 800}, "device": {"min_free_gb": 2}}}
    made = Plan({"datasets": {"cut": cut}, "methods": {"vanilla": {}}}, str(REPOSITORY))
    assert settings(made, "blocks")["card"] == {"memory_gb": 8.0, "gaussians": 1_500_000, "width": 800}


def jobs(*named: tuple[str, str]) -> list[SimpleNamespace]:
    """Jobs by rule and scene, and one without a scene."""
    made = [SimpleNamespace(rule=SimpleNamespace(name=rule), wildcards=at(scene)) for rule, scene in named]
    return [*made, SimpleNamespace(rule=SimpleNamespace(name="gap_report"), wildcards=SimpleNamespace())]


def test_planning_says_the_chosen_length_of_blocks_and_why(tmp_path):
    made = auto(str(tmp_path), memory_gb=12)
    (sentence,) = chosen_lengths(made.config, jobs(("blocks", "way")))
    assert sentence == (
        "scene way: the length of its blocks is chosen by blocks.memory_gb: 12 when it is cut, which says why"
    )
    (tmp_path / "way").mkdir()
    content = {"blocks": [{}] * 3, "length_m": 120.0, "reason": "the images fit"}
    (tmp_path / "way/blocks.json").write_text(json.dumps(content))
    known = chosen_lengths(made.config, jobs(("train", "way.000"), ("train", "way.001"), ("film_blocks", "way")))
    assert known == ["scene way: blocks of 120 m: the images fit"]
    assert chosen_lengths(made.config, jobs(("blocks", "way"), ("train", "way.001"))) == [sentence], "it is cut again"
    assert chosen_lengths(made.config, jobs()) == []
    assert chosen_lengths(plan().config, jobs(("train", "way.000"), ("train", "0001"))) == []
