"""A synthetic world never overwrites a recorded dataset."""

import json
import warnings
from pathlib import Path

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.settings.world import WorldJob, WorldSettings
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings
from drivesplat.world.generate import make_world
from drivesplat.world.marker import WORLD_MARKER, prepare_folder, refuse_foreign_data

TINY = WorldJob(
    scene="demo", version="v1.0-mini", world=WorldSettings(width=64, samples_per_pixel=1, key_frames=2)
)  # fmt: skip
REPLY = "holds other files"


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def recorded(tmp_path) -> Path:
    """The folder of a recorded dataset."""
    for name in ("samples/CAM_FRONT/a.jpg", "sweeps/LIDAR_TOP/b.pcd.bin", "v1.0-mini/sample.json", "maps/c.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    return tmp_path


@pytest.mark.parametrize(
    "write", [lambda root: prepare_folder(root, {}), lambda root: make_world(root, TINY, {"stages": {}})]
)
def test_a_recorded_dataset_is_refused_and_left_as_it_is(recorded, write):
    before = content(recorded)
    with pytest.raises(ConfigError, match=REPLY) as refused:
        write(recorded)
    assert str(recorded) in str(refused.value) and "dataroot" in str(refused.value)
    assert content(recorded) == before


@pytest.mark.parametrize("name", ["notes.txt", "samples/CAM_FRONT/a.jpg", "deep/er/still/x"])
def test_a_single_foreign_file_is_refused(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(ConfigError, match=REPLY):
        refuse_foreign_data(tmp_path)


def test_absent_and_empty_folders_and_earlier_worlds_are_accepted(tmp_path):
    refuse_foreign_data(tmp_path / "absent")
    (tmp_path / "empty" / "v1.0-mini").mkdir(parents=True)
    refuse_foreign_data(tmp_path / "empty")
    prepare_folder(tmp_path / "empty", {"stages": {}})
    (tmp_path / "empty" / "samples").mkdir()
    (tmp_path / "empty" / "samples" / "x.jpg").write_text("")
    refuse_foreign_data(tmp_path / "empty")


def test_preparing_removes_an_earlier_world_and_records_the_new_provenance(tmp_path):
    prepare_folder(tmp_path, {"stages": {"demo_world": {"code": "old"}}})
    for folder in ("samples", "sweeps", "maps", "truth", "semantic", "sky"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "old").write_text("")
    prepare_folder(tmp_path, {"stages": {"demo_world": {"code": "new"}}})
    assert list(content(tmp_path)) == [WORLD_MARKER]
    assert json.loads((tmp_path / WORLD_MARKER).read_text())["provenance"]["stages"]["demo_world"]["code"] == "new"


def plan(**config) -> Plan:
    return Plan(config, str(REPOSITORY))


def demo(root: Path, **settings) -> dict:
    return {"dataroot": str(root), "scenes": ["demo"], "world": {}, "batch": False, **settings}


@pytest.mark.parametrize(
    "target", ["results/demo/metrics.json", "results/demo/vanilla/checkpoint.npz", "{}/v1.0-mini/log.json"]
)
def test_planning_refuses_a_world_in_a_recorded_datasets_folder_before_any_job(recorded, target):
    before = content(recorded)
    with pytest.raises(ConfigError, match=REPLY):
        plan(datasets={"demo": demo(recorded)}).refuse_absent_data([target.format(recorded)])
    assert content(recorded) == before


def test_planning_needs_no_data_for_a_world_that_is_yet_to_be_made(tmp_path):
    plan(datasets={"demo": demo(tmp_path / "new")}).refuse_absent_data(["results/demo/metrics.json"])
    assert not (tmp_path / "new").exists()


def test_two_worlds_in_one_dataroot_are_refused(tmp_path):
    other = demo(tmp_path, scenes=["other"])
    with pytest.raises(ConfigError, match="two datasets make their world in the same dataroot"):
        load({"datasets": {"demo": demo(tmp_path), "other": other}})
    load({"datasets": {"demo": demo(tmp_path), "other": {**other, "dataroot": str(tmp_path / "other")}}})


@pytest.mark.parametrize("scenes", [[], ["a", "b"]])
def test_a_world_has_one_scene(tmp_path, scenes):
    with pytest.raises(ConfigError, match="a dataset with a world has one scene"):
        load({"datasets": {"demo": demo(tmp_path, scenes=scenes)}})


def test_a_worlds_stage_knows_its_scene_tables_and_street_alone(tmp_path):
    first = demo(tmp_path, world={"random_seed": 3, "night": True})
    config = load({"datasets": {"demo": first}, "random_seed": 7, "train": {"iterations": 50}})
    told = json.loads(stage_settings(config, "demo_world", "demo"))
    assert told["scene"] == "demo" and told["version"] == "v1.0-mini"
    expected = {"cameras": ["CAM_FRONT"], "sweeps": [], "random_seed": 3, "night": True}
    assert told["world"] == {**WorldSettings().model_dump(mode="json"), **expected}
    assert told.keys() == {"scene", "version", "world", "edits"} and told["edits"] == {}


@pytest.mark.parametrize(
    ("written", "read", "recorded"),
    [
        (None, {}, []),
        (None, {"sweeps": True, "cameras": ["CAM_BACK", "side"], "eval_camera": "CAM_BACK"}, ["CAM_BACK"]),
        (None, {"sweeps": True}, ["CAM_FRONT", "CAM_BACK"]),
        (None, {"lidar_seed": {"sweeps": True}}, ["LIDAR_TOP"]),
        (None, {"sweeps": True, "lidar_seed": {"sweeps": True}}, ["CAM_FRONT", "CAM_BACK", "LIDAR_TOP"]),
        (["CAM_BACK"], {}, ["CAM_BACK"]),
        ([], {"sweeps": True}, []),
    ],
)
def test_a_world_records_between_key_frames_what_is_read_there_unless_its_settings_name_sensors(
    tmp_path, written, read, recorded
):
    datasets = {"demo": demo(tmp_path, world={"sweeps": written, "cameras": ["CAM_FRONT", "CAM_BACK"]})}
    config = load({"datasets": datasets, "cameras": ["CAM_FRONT", "CAM_BACK"], **read})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert json.loads(stage_settings(config, "demo_world", "demo"))["world"]["sweeps"] == recorded


def test_wrong_settings_of_a_world_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"datasets.demo.world.width.*10"):
        load({"datasets": {"demo": demo(tmp_path, world={"width": 10})}})
    with pytest.raises(ConfigError, match=r"datasets.demo.world.sweeps"):
        load({"datasets": {"demo": demo(tmp_path, world={"sweeps": ["RADAR_FRONT"]})}})
