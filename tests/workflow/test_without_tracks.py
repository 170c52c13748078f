"""Planning of drives without boxes: which method takes the place of `street`, and what is said of it."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.drives import World, write_world

from drivesplat.errors import ConfigError
from drivesplat.readers.drive.annotated import has_tracks as folder_has_tracks
from drivesplat.readers.nuscenes.annotated import has_tracks as tables_have_tracks
from drivesplat.settings.config import load
from drivesplat.settings.method import merged
from drivesplat.settings.without_boxes import substitutes
from drivesplat.workflow.named_tracks import edits_left_out
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.without_cameras import methods_left_out
from drivesplat.workflow.without_tracks import in_place_of_street, methods_without_boxes

BEAMS = {"top": {"beam_elevations": [-0.1, 0.1]}}
SWEEPS = [{"lidar": "top", "timestamp": 500_000 * i, "file": f"top/{i}.npz"} for i in range(10)]
TRACKS = [{"id": "a", "class": "car", "size": [4, 2, 2], "poses": []}]
FRAMES = [{"camera": "front", "timestamp": 500_000 * i, "file": f"front/{i}.jpg"} for i in range(10)]
CAMERAS = {"front": {"width": 1600, "height": 900}}
SCANNED = {"cameras": CAMERAS, "frames": FRAMES, "lidars": BEAMS, "sweeps": SWEEPS}
DRIVES: dict[str, dict[str, Any]] = {
    "boxed": {**SCANNED, "tracks": TRACKS},
    "scanned": SCANNED,
    "empty_list": {**SCANNED, "tracks": []},
    "no_lidar": {"cameras": CAMERAS, "frames": FRAMES},
    "solid_state": {**SCANNED, "lidars": {"top": {}}},
    "lidar_alone": {"lidars": BEAMS, "sweeps": SWEEPS},
    "faulty": {**SCANNED, "tracks": TRACKS, "sweeps": 7},
}
METHODS = {
    "boxed": ["vanilla", "street"],
    "scanned": ["vanilla", "street_discovered"],
    "empty_list": ["vanilla", "street_discovered"],
    "no_lidar": ["vanilla", "drifting"],
    "solid_state": ["vanilla", "drifting"],
    "lidar_alone": [],
    "faulty": ["vanilla", "street"],
}
ALONE = {"cameras": [], "eval_camera": None}
SHIPPED = yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))
LIDAR = yaml.safe_load((REPOSITORY / "presets/lidar.yaml").read_text(encoding="utf-8"))
WITHOUT_BOXES = yaml.safe_load((REPOSITORY / "presets/without_boxes.yaml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("drives")
    for name, content in DRIVES.items():
        (root / name).mkdir()
        (root / name / "drive.json").write_text(json.dumps(content))
        (root / name / "top").mkdir()
        (root / name / "top/0.npz").write_bytes(b"PK\x05\x06" + bytes(18))  # an archive without members: no rings
    return root


def values(root: Path, *scenes: str, **more: Any) -> dict[str, Any]:
    """The shipped settings with these drives as a batch, and `more` laid over them."""
    mine = {"reader": "drive", "dataroot": str(root), "scenes": [name for name in scenes if name != "lidar_alone"]}
    alone = {**mine, "scenes": ["lidar_alone"], "overrides": ALONE}
    datasets = {"mine": mine, **({"alone": alone} if "lidar_alone" in scenes else {})}
    own = {"cameras": ["front"], "eval_camera": "front", "results_dir": "r"}
    return {**merged(SHIPPED, own | more), "datasets": datasets}


def plan(root: Path, *scenes: str, **more: Any) -> Plan:
    return Plan(values(root, *(scenes or DRIVES), **more), str(REPOSITORY))


def at(scene: str, method: str | None = None, **more: str) -> SimpleNamespace:
    return SimpleNamespace(scene=scene, **({"method": method} if method else {}), **more)


def folders(files: list[str], scene: str) -> set[str]:
    """The methods in whose folders some of the files lie."""
    parts = [Path(file).parts for file in files]
    return {part[2] for part in parts if part[1] == scene and len(part) > 3 and part[2] != "discovered"}


@pytest.mark.parametrize("scene", DRIVES)
def test_the_methods_of_a_drive_follow_from_its_boxes_scans_and_cameras(drives, scene):
    made = plan(drives)
    assert made.evals(at(scene)) == [f"r/{scene}/{method}/eval.json" for method in METHODS[scene]]
    targets = [*made.films(), *made.looks(), *made.exports(), *made.report([]).links(), *made.alpasim()]
    assert folders(targets, scene) == set(METHODS[scene])
    if scene != "lidar_alone":
        assert made.checkpoints(at(scene)) == [f"r/{scene}/{method}/checkpoint.npz" for method in METHODS[scene]]
        viewer = json.loads(made.stage_settings("export_viewer", scene, "vanilla"))
        assert viewer["methods"] == sorted(METHODS[scene])
        stages = made.metrics_stages(scene)
        assert {name.partition("/")[0] for name in stages if "/" in name} == set(METHODS[scene])
        assert ("discover" in stages) == ("street_discovered" in METHODS[scene])
        assert [section.title for section in made.film_pages().job(scene).sections][1:] == METHODS[scene]


def test_what_a_job_reads_follows_from_the_methods_of_its_drive(drives):
    made = plan(drives)
    assert made.discovered(at("scanned")) == ["r/scanned/discovered.json"]
    assert made.discovered(at("boxed")) == made.discovered(at("no_lidar")) == []
    assert made.of_tracks("parser.npz")(at("scanned", "street_discovered")) == "r/scanned/discovered/parser.npz"
    assert made.of_tracks("parser.npz")(at("no_lidar", "drifting")) == "r/no_lidar/unlabelled/parser.npz"
    assert made.actors(at("scanned", tracks="discovered/")) == ["r/scanned/discovered/actors.npz"]
    assert made.actors(at("scanned", tracks="")) == [] != made.actors(at("boxed", tracks=""))
    pictures = [path for path in made.looks() if path.endswith("tracks.png")]
    assert "r/scanned/discovered/tracks.png" in pictures and "r/boxed/discovered/tracks.png" not in pictures
    no_vanilla = plan(drives, methods={"vanilla": None})
    assert no_vanilla.first_parser(at("scanned")) == "r/scanned/discovered/parser.npz"
    assert no_vanilla.first_parser(at("boxed")) == "r/boxed/parser.npz"


def test_a_drive_with_boxes_has_the_jobs_and_settings_that_it_has_by_itself(drives):
    """Neither other drives of the batch nor the replacement change one."""
    batch, alone, kept = plan(drives), plan(drives, "boxed"), plan(drives, "boxed", replace_street=False)
    for made in (batch, alone):
        assert made.metrics_stages("boxed") == kept.metrics_stages("boxed")
        for stage in ("export_viewer", "train", "evaluate", "compare", "actors"):
            names = (stage, "boxed", "street")
            assert made.stage_settings(*names) == kept.stage_settings(*names)
    mine = [path for path in (*batch.films(), *batch.looks(), *batch.exports()) if "/boxed/" in path]
    assert mine == [*kept.films(), *kept.looks(), *kept.exports()]
    assert alone.report([]).settings() == kept.report([]).settings()


def test_planning_says_in_a_sentence_what_is_trained_and_why(drives):
    made = plan(drives)
    scenes = {scene for scene, _ in made.scenes_and_methods([])}
    assert methods_without_boxes(made.config, scenes, made.scenes_and_methods([])) == [
        "scenes empty_list, scanned have no boxes: street_discovered takes the place of street, since its objects are "
        "found in LiDAR scans; methods there: vanilla, street_discovered (docs/without_boxes.md)",
        "scenes no_lidar, solid_state have neither boxes nor LiDAR sweeps with known beams: drifting takes the place "
        "of street, since it takes images alone; methods there: vanilla, drifting (docs/without_boxes.md)",
    ]
    assert methods_without_boxes(made.config, ["boxed"], {("boxed", "street")}) == []
    (left_out,) = methods_left_out(made.config, scenes)
    assert left_out.startswith("dataset alone has no camera") and left_out.endswith("(vanilla, street)")
    assert edits_left_out(made.config, scenes) == []


def test_a_sentence_names_four_of_many_scenes(drives, tmp_path):
    for i in range(6):
        (tmp_path / f"d{i}").mkdir()
        (tmp_path / f"d{i}/drive.json").write_text(json.dumps(DRIVES["no_lidar"]))
    made = plan(tmp_path, *(f"d{i}" for i in range(6)))
    (sentence,) = methods_without_boxes(made.config, made.config.scenes, set())
    assert sentence.startswith("scenes d0, d1, d2, d3 and 2 more have neither boxes nor")


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"replace_street": False}, ["vanilla", "street"]),
        ({"methods": {"street": {"overrides": {"train": {"dropout": 0.1}}}}}, ["vanilla", "street"]),
        ({"methods": {"street": None}}, ["vanilla"]),
        ({"methods": {"mine": {"of": "street"}}}, ["vanilla", "street_discovered", "mine"]),
        ({"methods": WITHOUT_BOXES["methods"]}, ["vanilla", "street_discovered", "drifting"]),
        ({"methods": LIDAR["methods"]}, ["vanilla", "street_discovered", *LIDAR["methods"]]),
        ({"methods": {"street_discovered": {"tracks": "none"}}}, ["vanilla", "street_discovered"]),
    ],
)
def test_methods_of_the_user_win(drives, more, expected):
    made = plan(drives, "scanned", **more)
    assert [Path(path).parts[2] for path in made.evals(at("scanned"))] == expected
    if "street_discovered" in more.get("methods", {}):
        own = load(merged(SHIPPED, more)).methods["street_discovered"]
        assert made.config.all_methods["street_discovered"] == own


def test_the_replacement_can_be_switched_off_for_one_dataset(drives):
    given = values(drives, "scanned")
    given["datasets"]["mine"]["overrides"] = {"replace_street": False}
    assert in_place_of_street(load(given), "scanned") is None


def test_a_drive_of_lidar_alone_keeps_the_methods_that_render_it(drives):
    made = plan(drives, "lidar_alone", methods=LIDAR["methods"])
    rendering = [name for name in LIDAR["methods"] if made.renders_lidar("lidar_alone", name)]
    assert made.evals(at("lidar_alone")) == [f"r/lidar_alone/{name}/eval.json" for name in rendering] != []
    said = methods_without_boxes(made.config, ["lidar_alone"], made.scenes_and_methods([]))
    assert said == [
        "scene lidar_alone has no boxes: methods with annotated tracks have no objects there "
        f"({', '.join(rendering)}); docs/without_boxes.md has others"
    ]


def test_street_can_still_be_asked_for_by_name(drives):
    made = plan(drives)
    target = "r/scanned/street/eval.json"
    made.refuse_unknown([target, "r/scanned/street_discovered/eval.json", "r/scanned/drifting/eval.json"])
    (sentence,) = methods_without_boxes(made.config, ["scanned"], made.scenes_and_methods([target]))
    assert sentence.startswith(
        "scene scanned has no boxes: methods with annotated tracks have no objects there (street)"
    )


def test_a_method_for_drives_without_boxes_is_refused_on_one_with_boxes(drives):
    with pytest.raises(
        ConfigError, match=r"^method 'street_discovered' is not in the config; .*there are: vanilla, str"
    ):
        plan(drives).refuse_unknown(["r/boxed/street_discovered/eval.json"])
    with pytest.raises(ConfigError, match=r"there are: vanilla, street_discovered; for the ablation"):
        plan(drives).refuse_unknown(["r/scanned/nothing/eval.json"])


def test_runs_of_street_are_driven_with_the_method_in_its_place(drives, tmp_path):
    (tmp_path / "runs.yaml").write_text(
        "runs: {calm: {policy: constant_speed}, own: {policy: recorded, methods: [vanilla]}}"
    )
    made = plan(drives, "boxed", "scanned", "no_lidar", runs=str(tmp_path / "runs.yaml"))
    assert [path.removeprefix("r/") for path in made.runs()] == [
        "boxed/vanilla/runs/own.json", "boxed/street/runs/calm.json",
        "scanned/vanilla/runs/own.json", "scanned/street_discovered/runs/calm.json",
        "no_lidar/vanilla/runs/own.json", "no_lidar/drifting/runs/calm.json",
    ]  # fmt: skip


def test_the_methods_in_its_place_are_those_of_the_preset():
    methods = load(merged(SHIPPED, WITHOUT_BOXES)).methods
    assert {name: methods[name] for name in substitutes()} == substitutes()


def test_absent_recordings_and_synthetic_worlds_count_as_annotated(drives, tmp_path):
    made = plan(tmp_path / "nowhere", "scanned")
    assert made.evals(at("scanned"))[1:] == ["r/scanned/street/eval.json"]
    demo = Plan({**SHIPPED, "results_dir": "r"}, str(REPOSITORY))
    assert demo.evals(at("demo"))[1:] == ["r/demo/street/eval.json"]


def test_readers_say_whether_a_recording_has_boxes(drives, tmp_path):
    assert [folder_has_tracks(drives, "", name) for name in ("boxed", "scanned", "empty_list")] == [True, False, False]
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad/drive.json").write_text("[1]")
    assert folder_has_tracks(tmp_path, "", "bad") is None
    for name, things in (("boxes", None), ("test", [])):
        world = World(
            key_frames=3, width=32, height=18, sweeps_between=0, **({} if things is None else {"things": things})
        )
        write_world(tmp_path / name, world)
    assert tables_have_tracks(tmp_path / "test", "v1.0-mini", "0001") is False
    assert tables_have_tracks(tmp_path / "boxes", "v1.0-mini", "0001") is None
    assert tables_have_tracks(tmp_path / "nowhere", "v1.0-mini", "0001") is None
    tables = {"dataroot": str(tmp_path / "test"), "scenes": ["0001"]}
    made = Plan({**SHIPPED, "datasets": {"nuscenes": tables}, "results_dir": str(tmp_path / "r")}, str(REPOSITORY))
    assert [Path(path).parts[-2] for path in made.evals(at("0001"))] == ["vanilla", "street_discovered"]
