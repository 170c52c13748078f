"""Methods with annotated, discovered and no tracks through the whole workflow; the LiDAR says its beams."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import Thing, World, default_things
from helpers.killed_runs import only_complaint
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

from drivesplat.io.video import read_footage
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.trajectories.actor_record import read_actors

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("discovered_workflow")]
ACTORS = ["background", "actors"]
SUPERVISED = {"train": {"depth_weight": 0.01, "scans": {"per_image": 0.2}}}
METHODS = {
    "vanilla": {"parts": ["background"]},
    "street": {"parts": ACTORS, "overrides": {"train": {"depth_weight": 0.01}}},
    "found": {"parts": ACTORS, "tracks": "discovered", "overrides": SUPERVISED},
    "blind": {"parts": ["background"], "tracks": "none"},
}
EDITS = """\
edits:
  found_gone:
    - remove: {track: found_0001}
  labelled_gone:
    - remove: {track: 0001 instance 0}
"""
SETTINGS = {
    "datasets": {"nuscenes": {"dataroot": "data", "scenes": ["0001"], "edits": {"0001": "edits.yaml"}}},
    "lidar_seed": {"sweeps": True, "max_points": 500, "far_points": 100},
    "scans": {"sweeps": True, "azimuth_steps": 480, "spin": None},
    "holdout": {"every_nth": 4, "offset": 2, "last_block": 1},
    "actors": {"humans": True},
    "train": {**TINY_TRAINING, "iterations": 40},
}
METRICS = "results/0001/metrics.json"


def made(folder: Path, things: list[Thing], methods: dict) -> WorkflowCopy:
    world = World(key_frames=8, lidar_between=4, rings=True, things=things)
    copy = WorkflowCopy.make(folder, world, methods=methods, **SETTINGS)
    (copy.folder / "edits.yaml").write_text(EDITS)
    return copy


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    found = made(tmp_path_factory.mktemp("discovered") / "workflow", default_things(), METHODS)
    done = found.run(METRICS)
    assert done.returncode == 0, done.stdout
    return found


def test_metrics_are_measured_alike_and_say_which_tracks_each_method_had(copy):
    metrics = copy.read(METRICS)
    methods = metrics["methods"]
    tracks = {name: method["tracks"] for name, method in methods.items()}
    assert tracks == {"vanilla": "annotated", "street": "annotated", "found": "discovered", "blind": "none"}
    for group in ("interpolation", "extrapolation"):
        known = [{method[group][region]["pixels"] for method in methods.values()} for region in ("static", "all")]
        assert [len(pixels) for pixels in known] == [1, 1] and min(known[0]) < min(known[1]), (
            "objects are known from boxes, even to `blind`"
        )
    assert methods["found"]["interpolation"]["lidar"]["moving_vehicle"]["returns"] > 50
    assert metrics["tracks_quality"]["vehicle"]["recall"] == metrics["tracks_quality"]["vehicle"]["precision"] == 1.0
    assert {"discover", "relabel", "regions", "scan_baselines"} < metrics["provenance"]["stages"].keys()


def test_what_a_training_reads_comes_from_its_own_tracks(copy):
    folder = copy.folder / "results/0001"
    drives = [read_scene(folder / name / "scene.json") for name in ("", "discovered", "unlabelled")]
    given, found, none = ({track.id for track in drive.tracks} for drive in drives)
    assert found == {"found_0001", "found_0002"} and none == set() != given
    given, found = (read_actors(folder / name / "actors.npz").actors for name in ("", "discovered"))
    assert [actor.id for actor in found] == ["found_0001", "found_0002"] and len(given) == 2
    found = read_scans(folder / "discovered/scans.npz")
    assert found.tracks == ["found_0001", "found_0002"] and set(np.unique(found.scans[0].objects)) == {-1, 0, 1}
    for name in ("discovered", "unlabelled"):
        made_here = {path.name for path in (folder / name).iterdir() if not path.name.startswith(".")}
        more = {"actors.npz", "lidar_depth.npz", "scans.npz"} if name == "discovered" else set()
        assert made_here == {"scene.json", "seed.ply", "parser.pkl", "parser.npz", "masks", *more}
        sky = next((folder / "masks/sky").rglob("*.png"))
        assert sky.samefile(folder / name / sky.relative_to(folder))


def test_nothing_is_left_to_do_and_a_setting_of_the_search_concerns_methods_with_its_tracks_alone(copy):
    assert copy.planned(METRICS) == {}
    with copy.set_to(discover={"lidar": "LIDAR_TOP"}):
        planned = copy.planned(METRICS)
    assert planned["discover"] == planned["relabel"] == planned["train"] == planned["evaluate"] == 1
    assert not {"extract", "masks"} & planned.keys() and planned["scans"] == 1


def test_discovered_objects_can_be_edited_shown_and_exported(copy):
    folder = "results/0001/found"
    targets = ["gone.mp4", "gone/drive/drive.json", "gone/scans/scans.json"]
    targets = [f"edits/found_{name}" for name in targets] + ["removal.png", "ghost_panel.png", "parts.mp4"]
    targets = [f"{folder}/{name}" for name in (*targets, "viewer.html", "parts/parts.json")]
    done = copy.run(*targets, "results/0001/discovered/tracks.png")
    assert done.returncode == 0, done.stdout
    labels = copy.read(f"{folder}/edits/found_gone.json")
    assert [track["id"] for track in labels["tracks"] if track["editable"]] == ["found_0002"]
    assert read_footage(copy.folder / folder / "edits/found_gone.mp4").frames == labels["frames"]
    drive = copy.read(f"{folder}/edits/found_gone/drive/drive.json")
    assert {track["id"] for track in drive["tracks"]} == {"found_0002"}
    removal, panel = (copy.read(f"{folder}/{name}.json") for name in ("removal", "ghost_panel"))
    assert removal["removed_by"] == "actor" and removal["subject"]["track"] == panel["subject"]["track"] == "found_0001"
    assert "found_0001" in (copy.folder / folder / "parts/parts.json").read_text()
    with open(copy.folder / "results/0001/discovered/tracks.csv", newline="", encoding="utf-8") as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    assert rows.keys() == {"found_0001", "found_0002"} and rows["found_0001"]["editable"] == "True"
    assert rows["found_0001"]["category"] == "discovered.car"


def test_a_discovered_track_that_there_is_none_of_is_refused_before_the_training(copy, tmp_path):
    again = copy.again(tmp_path / "workflow")
    (again.folder / "edits.yaml").write_text("edits: {late: [remove: {track: found_0009}]}")
    line = only_complaint(again.run("results/0001/found/edits/late.mp4"))
    assert "no track has an id starting with 'found_0009'" in line and "found_0001" in line


def test_a_drive_where_nothing_moves_trains_the_background_alone(tmp_path):
    things = [thing for thing in default_things() if not any(thing.velocity)]
    still = made(tmp_path / "workflow", things, {name: METHODS[name] for name in ("vanilla", "found")})
    done = still.run(METRICS, "results/0001/discovered/tracks.png")
    assert done.returncode == 0 and "Traceback" not in done.stdout, done.stdout
    assert still.read("results/0001/discovered.json")["tracks"] == []
    metrics = still.read(METRICS)
    for group in ("interpolation", "extrapolation"):
        assert metrics["methods"]["found"][group]["moving_vehicle"] is None
        assert metrics["methods"]["found"][group]["static"]["psnr"] > 10.0
    assert json.loads((still.folder / "results/0001/found/train.json").read_text())["gaussians"] > 0
