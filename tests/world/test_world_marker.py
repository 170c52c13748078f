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


def write(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name)


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def demo(root: Path, **settings) -> dict:
    return {"dataroot": str(root), "scenes": ["demo"], "world": {}, "batch": False, **settings}


def plan(root: Path) -> Plan:
    return Plan({"datasets": {"demo": demo(root)}}, str(REPOSITORY))


def test_a_recorded_dataset_is_refused_before_any_job_and_left_as_it_is(tmp_path):
    write(tmp_path, "samples/CAM_FRONT/a.jpg", "sweeps/LIDAR_TOP/b.pcd.bin", "v1.0-mini/sample.json", "maps/c.png")
    before = content(tmp_path)
    with pytest.raises(ConfigError, match=REPLY) as refused:
        make_world(tmp_path, TINY, {"stages": {}})
    assert str(tmp_path) in str(refused.value) and "dataroot" in str(refused.value)
    for target in (
        "results/demo/metrics.json",
        "results/demo/vanilla/checkpoint.npz",
        f"{tmp_path}/v1.0-mini/log.json",
    ):
        with pytest.raises(ConfigError, match=REPLY):
            plan(tmp_path).refuse_absent_data([target])
    assert content(tmp_path) == before


@pytest.mark.parametrize("name", ["notes.txt", "samples/CAM_FRONT/a.jpg", "deep/er/still/x"])
def test_a_single_foreign_file_is_refused(tmp_path, name):
    write(tmp_path, name)
    with pytest.raises(ConfigError, match=REPLY):
        refuse_foreign_data(tmp_path)


def test_absent_and_empty_folders_are_accepted_and_earlier_worlds_replaced(tmp_path):
    plan(tmp_path / "absent").refuse_absent_data(["results/demo/metrics.json"])
    refuse_foreign_data(tmp_path / "absent")
    assert not (tmp_path / "absent").exists()
    root = tmp_path / "empty"
    (root / "v1.0-mini").mkdir(parents=True)
    refuse_foreign_data(root)
    prepare_folder(root, {"stages": {"demo_world": {"code": "old"}}})
    write(root, *(f"{folder}/old" for folder in ("samples", "sweeps", "maps", "truth", "semantic", "sky")))
    prepare_folder(root, {"stages": {"demo_world": {"code": "new"}}})
    assert list(content(root)) == [WORLD_MARKER]
    assert json.loads((root / WORLD_MARKER).read_text())["provenance"]["stages"]["demo_world"]["code"] == "new"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": []}, "a dataset with a world has one scene"),
        ({"scenes": ["a", "b"]}, "a dataset with a world has one scene"),
        ({"world": {"width": 10}}, r"datasets.demo.world.width.*10"),
        ({"world": {"sweeps": ["RADAR_FRONT"]}}, r"datasets.demo.world.sweeps"),
    ],
)
def test_wrong_settings_of_a_world_are_named(tmp_path, changes, words):
    with pytest.raises(ConfigError, match=words):
        load({"datasets": {"demo": demo(tmp_path, **changes)}})


def test_two_worlds_in_one_dataroot_are_refused(tmp_path):
    first, second, elsewhere = (
        demo(tmp_path),
        *(demo(root, scenes=["other"]) for root in (tmp_path, tmp_path / "other")),
    )
    with pytest.raises(ConfigError, match="two datasets make their world in the same dataroot"):
        load({"datasets": {"demo": first, "other": second}})
    load({"datasets": {"demo": first, "other": elsewhere}})


def test_a_worlds_stage_knows_its_scene_tables_and_street_alone(tmp_path):
    first = demo(tmp_path, world={"random_seed": 3, "night": True})
    config = load({"datasets": {"demo": first}, "random_seed": 7, "train": {"iterations": 50}})
    told = json.loads(stage_settings(config, "demo_world", "demo"))
    assert told["scene"] == "demo" and told["version"] == "v1.0-mini"
    expected = {"cameras": ["CAM_FRONT"], "sweeps": [], "random_seed": 3, "night": True}
    assert told["world"] == {**WorldSettings().model_dump(mode="json"), **expected}
    assert told.keys() == {"scene", "version", "world", "edits", "donors"} and told["edits"] == told["donors"] == {}


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
