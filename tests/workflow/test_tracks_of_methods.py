"""Which results a method with annotated, discovered or no tracks reads, and which edits and vehicles it shows."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.workflow.named_tracks import edits_left_out, refuse_wrong_tracks
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings

ACTORS = ["background", "actors"]
SUPERVISED = {"train": {"depth_weight": 0.01, "scans": {"per_image": 0.2}}}
METHODS = {
    "vanilla": {},
    "street": {"parts": ACTORS, "overrides": SUPERVISED},
    "found": {"parts": ACTORS, "tracks": "discovered", "overrides": SUPERVISED},
    "blind": {"tracks": "none"},
}
EDITS = """\
edits:
  labelled:
    - remove: {track: aa}
  discovered:
    - stop: {track: found_0001, at: 1.0}
  both:
    - swap: {track: aa, with: found_0002}
  ego_alone:
    - ego: {lateral: 2.0}
"""


def plan(**values: Any) -> Plan:
    datasets = {"a": {"scenes": ["a1"]}, "lidar": {"scenes": ["b1"], "overrides": {"cameras": [], "eval_camera": None}}}
    given = {"datasets": datasets, "results_dir": "r", "refine_poses": {"enabled": False}, "methods": METHODS}
    return Plan({**given, **values}, str(REPOSITORY))


def at(method: str | None = None, tracks: str | None = None, scene: str = "a1", **more: str) -> SimpleNamespace:
    given = {"method": method, "tracks": tracks, **more}
    return SimpleNamespace(scene=scene, **{name: value for name, value in given.items() if value is not None})


@pytest.mark.parametrize(("method", "folder"), [("street", ""), ("found", "discovered/"), ("blind", "unlabelled/")])
def test_trainings_and_stages_read_what_was_made_for_their_tracks(method, folder):
    made, stages = plan(), ("actors", "lidar_depth", "scans")
    for job in (at(method), at(tracks=folder)):
        assert made.scene(job) == f"r/a1/{folder}scene.json"
        assert made.of_images("seed.ply", of_tracks=True)(job) == [f"r/a1/{folder}seed.ply"]
    assert made.of_tracks("parser.pkl")(at(method)) == f"r/a1/{folder}parser.pkl"
    taken = [file for stage in stages for file in made.training_input(stage)(at(method))]
    assert taken == ([] if method == "blind" else [f"r/a1/{folder}{stage}.npz" for stage in stages])
    job = at(tracks=folder)
    assert made.of_images("seed.ply", of_tracks=True)(at(tracks=folder, scene="b1")) == []
    assert made.actors(job) == ([] if method == "blind" else [f"r/a1/{folder}actors.npz"])
    assert made.discovered(job) == (["r/a1/discovered.json"] if method == "found" else [])


def test_all_methods_are_measured_with_annotated_tracks():
    made = plan()
    for method in METHODS:
        assert made.annotated_scene(at(method)) == "r/a1/scene.json"
        scans = ["r/a1/scans.npz"] if method in ("street", "found") else []
        assert made.measured_scans(at(method)) == scans
        job = json.loads(made.stage_settings("evaluate", "a1", method))
        assert job["tracks"] == METHODS[method].get("tracks", "annotated")
    assert json.loads(made.stage_settings("evaluate_scans", "b1", "found"))["tracks"] == "discovered"
    assert made.discovered(at()) == ["r/a1/discovered.json"]
    assert plan(methods={"vanilla": {}}).discovered(at()) == []


def test_pictures_show_the_tracks_of_the_method_and_annotated_ones_without_any():
    made = plan()
    shown = {method: Path(made.shown_scene(at(method))).parent for method in METHODS}
    assert shown == {name: Path("r/a1") for name in METHODS} | {"found": Path("r/a1/discovered")}
    assert all(Path(made.shown_masks(at(name))) == folder / "masks/masks.json" for name, folder in shown.items())
    tables = [file for file in made.looks() if file.endswith("tracks.png")]
    assert tables == ["r/a1/tracks.png", "r/a1/discovered/tracks.png"]
    assert plan(methods={"found": METHODS["found"]}).looks()[0] == "r/a1/discovered/tracks.png"


OF_TRACKS = {"found": {"scans", "discover", "relabel", "regions"}, "blind": {"relabel", "regions"}}


@pytest.mark.parametrize("method", METHODS)
def test_a_report_expects_the_stages_that_give_a_method_its_tracks(method):
    settings = {**METHODS[method], "overrides": {}}
    stages = plan(methods={method: settings}).metrics_stages("a1")
    ours = {"scans", "discover", "relabel", "regions", "scan_baselines"}
    assert {name for name in stages if name in ours} == OF_TRACKS.get(method, set())


def test_targets_in_the_folders_of_tracks_are_known():
    made = plan()
    made.refuse_unknown(["r/a1/discovered/tracks.csv", "r/a1/unlabelled/seed.ply", "r/b1/discovered/actors.npz"])
    with pytest.raises(ConfigError, match="has no camera"):
        made.refuse_unknown(["r/b1/discovered/seed.ply"])
    with pytest.raises(ConfigError, match="method 'discover' is not in the config"):
        made.refuse_unknown(["r/a1/discover/seed.ply"])


def test_actors_without_tracks_are_refused():
    with pytest.raises(ConfigError, match=r"tracks: none leaves the part 'actors' without objects.*tracks: discovered"):
        plan(methods={"mine": {"parts": ACTORS, "tracks": "none"}})
    with pytest.raises(ConfigError, match="'annotated', 'discovered' or 'none'"):
        plan(methods={"mine": {"tracks": "found"}})


# ---- edits and vehicles that settings name


@pytest.fixture
def edited(tmp_path) -> dict[str, Any]:
    (tmp_path / "edits.yaml").write_text(EDITS)
    return {"datasets": {"a": {"scenes": ["a1"], "edits": {"a1": str(tmp_path / "edits.yaml")}}}}


def test_edits_are_made_by_methods_with_the_tracks_that_they_name(edited):
    made = plan(**edited)
    films = {file.removeprefix("r/a1/").removesuffix(".mp4") for file in made.edits()}
    assert films == {
        "street/edits/labelled", "street/edits/ego_alone", "found/edits/discovered", "found/edits/ego_alone",
    }  # fmt: skip
    pages = {name: json.loads(made.stage_settings("export_viewer", "a1", name))["edits"].keys() for name in METHODS}
    assert pages["street"] == {"labelled", "ego_alone"} and pages["found"] == {"discovered", "ego_alone"}
    (left_out,) = edits_left_out(made.config, ["a1", "a1"])
    assert left_out.startswith("scene a1: no method has the tracks") and left_out.count("both") == 1
    (left_out,) = edits_left_out(plan(**edited, methods={"street": METHODS["street"]}).config, ["a1"])
    assert "left out: discovered, both (methods.<name>.tracks: annotated)" in left_out
    assert edits_left_out(plan(**edited, methods={"blind": METHODS["blind"]}).config, ["a1"]) == []


def test_an_edit_of_other_tracks_is_refused_with_the_methods_that_have_them(edited):
    made = plan(**edited)
    made.refuse_unknown(["r/a1/found/edits/discovered.mp4", "r/a1/street/quad/labelled.mp4"])
    for target, words in {
        "street/edits/discovered.mp4": ("names found_0001", "'street' has tracks: annotated", "this edit: found"),
        "found/edits/labelled/drive/drive.json": ("names aa", "'found' has tracks: discovered", "this edit: street"),
        "found/quad/both.mp4": ("names aa, found_0002", "this edit: none"),
    }.items():
        with pytest.raises(ConfigError) as refused:
            made.refuse_unknown([f"r/a1/{target}"])
        assert all(word in str(refused.value) for word in words) and "\n" not in str(refused.value), refused.value


def job_of(rule: str, output: str = "", **wildcards: str) -> SimpleNamespace:
    return SimpleNamespace(rule=SimpleNamespace(name=rule), output=[output], wildcards=SimpleNamespace(**wildcards))


def test_a_record_that_a_run_makes_is_left_to_its_stage(edited):
    """The file of the record is asked for where it is read alone."""
    made, asked = plan(**edited), []

    def scene_file(wildcards: Any) -> str:
        asked.append(wildcards.method)
        return made.shown_scene(wildcards)

    film = job_of("edit", scene="a1", method="found", edit="discovered")
    relabel = job_of("relabel", "r/a1/discovered/scene.json", scene="a1", tracks="discovered/")
    refuse_wrong_tracks(made.config, [film, relabel], scene_file)
    assert asked == ["found"]
    refuse_wrong_tracks(made.config, [film, job_of("extract", scene="a1")], scene_file)
    assert asked == ["found"]


@pytest.mark.parametrize(("track", "shown"), [("aa", "street"), ("found_0001", "found")])
def test_a_vehicle_is_shown_by_methods_with_its_track(track, shown):
    config = plan(subjects={"a1": {"track": track, "key_frame": 3}}).config
    for method in ("street", "found"):
        subject = json.loads(stage_settings(config, "remove_actor", "a1", method))["subject"]
        assert subject == ({"track": track, "key_frame": 3} if method == shown else {"track": None, "key_frame": None})
