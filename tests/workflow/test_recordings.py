"""What a recording lacks is refused when a run is planned, from drive.json alone."""

import copy
import json
import os
import re
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.readers.drive.layout import outline
from drivesplat.readers.outline import trained_key_frames
from drivesplat.settings.images import HoldoutSettings
from drivesplat.workflow.plan import Plan
from drivesplat.world.marker import WORLD_MARKER

CAMERA = {"width": 1600, "height": 900}
DRIVE: dict[str, Any] = {
    "cameras": {"front": CAMERA, "back": CAMERA},
    "lidars": {"top": {"beam_elevations": None}},
    "frames": [
        {"camera": camera, "timestamp": 500_000 * i, "file": f"{camera}/{i}.jpg"}
        for camera in ("front", "back")
        for i in range(10)
    ],
    "sweeps": [{"lidar": "top", "timestamp": 500_000 * i, "file": f"top/{i}.npz"} for i in range(10)],
}


MINE = {"reader": "drive", "scenes": ["one"]}


def changed(**values: Any) -> dict[str, Any]:
    """The drive with other values; None takes a key out."""
    return {key: value for key, value in {**copy.deepcopy(DRIVE), **values}.items() if value is not None}


def plan(root: Path, drives: dict[str, dict], **settings: Any) -> Plan:
    """The plan for drive folders in `root`, whose first sweep has rings."""
    for name, drive in drives.items():
        (root / name / "top").mkdir(parents=True)
        (root / name / "drive.json").write_text(json.dumps(drive))
        with zipfile.ZipFile(root / name / "top/0.npz", "w") as arrays:
            arrays.writestr("ring.npy", b"")
    mine = {"reader": "drive", "dataroot": str(root), "scenes": list(drives)}
    config = {"datasets": {"mine": mine}, "cameras": ["front"], "eval_camera": "front"}
    return Plan({**config, "results_dir": str(root / "results"), **settings}, str(REPOSITORY))


def refusal(made: Plan, *rules: str, scene: str = "one") -> str | None:
    """What is said of a run of some rules for a scene; None where nothing is."""
    wildcards = SimpleNamespace(scene=scene)
    jobs = [SimpleNamespace(rule=SimpleNamespace(name=rule), wildcards=wildcards, output=[""]) for rule in rules]
    try:
        made.check_jobs(jobs)
    except ConfigError as error:
        return str(error)
    return None


ALL = ("extract", "own_car", "lidar_seed", "scans", "train")


def test_a_clip_of_ncore_is_planned_by_its_metadata(tmp_path, tiny_scene):
    """Its LiDAR has no rows: no scans, and all else works."""
    pytest.importorskip("ncore")
    from helpers.ncore_clips import tables_recording, write_clip

    root = write_clip(tmp_path / "clips" / "one", tables_recording(tiny_scene)).parent
    mine = {"reader": "ncore", "dataroot": str(root), "scenes": ["one"]}
    config = {"datasets": {"mine": mine}, "cameras": ["front"], "eval_camera": "front"}
    made = Plan({**config, "results_dir": str(tmp_path / "results")}, str(REPOSITORY))
    assert refusal(made, "extract", "lidar_seed", "train") is None
    assert "scene one, LiDAR top: its returns have no rings" in refusal(made, "scans")
    made = Plan(
        {**config, "cameras": ["rear"], "eval_camera": "rear", "results_dir": str(tmp_path / "results")},
        str(REPOSITORY),
    )
    assert "the drive has no camera 'rear'; there are: front" in refusal(made, "extract")


def test_images_alone_are_refused_where_the_seed_needs_lidar(tmp_path):
    drive = changed(sweeps=[], lidars=None)
    made = plan(tmp_path, {"one": drive})
    said = "scene one has no LiDAR sweeps; set lidar_seed.on_missing: warn to seed from images alone"
    assert refusal(made, "lidar_seed") == said
    assert refusal(made, "extract", "own_car") is None, "these need no LiDAR"
    assert refusal(plan(tmp_path / "b", {"one": drive}, lidar_seed={"on_missing": "warn"}), "lidar_seed") is None
    assert refusal(made, "scans").startswith("scene one has no LiDAR sweep that gives a scan; ")


@pytest.mark.parametrize(
    ("key_frames", "holdout", "frames", "refused"),
    [
        (4, {}, None, True),
        (5, {}, None, False),
        (10, {"last_block": 10}, None, True),
        (10, {}, (0, 4), True),
        (10, {"every_nth": 0, "last_block": 0}, (0, 1), False),
        (1, {}, None, True),
    ],
)
def test_a_hold_out_of_all_key_frames_is_refused(tmp_path, key_frames, holdout, frames, refused):
    drive = changed(frames=[frame for frame in DRIVE["frames"] if frame["timestamp"] < 500_000 * key_frames])
    mine = {**MINE, "dataroot": str(tmp_path), "frames": {"one": frames} if frames else {}}
    said = refusal(plan(tmp_path, {"one": drive}, holdout=holdout, datasets={"mine": mine}), "lidar_seed")
    count = frames[1] - frames[0] if frames else key_frames
    assert said == (
        f"scene one: the hold-out leaves none of its {count} key frames to train on; lower holdout.last_block or "
        "holdout.neighbourhood_s, or set holdout.every_nth: 0"
        if refused
        else None
    )


def test_key_frames_near_a_held_out_one_are_not_trained_on_at_ten_hertz():
    """What is surely within 0.25 s: image times may differ from key frames by half an interval."""
    times = [100_000 * i for i in range(12)]
    assert trained_key_frames(times, HoldoutSettings(every_nth=4, offset=2, last_block=1)) == [0, 4, 8]
    assert trained_key_frames(times, HoldoutSettings(every_nth=3, offset=1, last_block=1)) == []
    assert trained_key_frames([5 * t for t in times], HoldoutSettings(every_nth=3, offset=1, last_block=1)) == [
        0, 2, 3, 5, 6, 8, 9,
    ]  # fmt: skip


def test_a_camera_or_frames_that_one_drive_lacks_are_refused_for_that_drive(tmp_path):
    lacking = changed(cameras={"front": CAMERA})
    made = plan(tmp_path, {"one": DRIVE, "two": lacking}, cameras=["front", "back"])
    assert refusal(made, *ALL) is None
    assert refusal(made, *ALL, scene="two") == "scene two: the drive has no camera 'back'; there are: front"
    made.refuse_unknown_cameras("mine", ["front", "back"])
    mine = {**MINE, "dataroot": str(tmp_path), "frames": {"one": (2, 11)}}
    said = refusal(
        Plan({**made.config.model_dump(mode="json"), "datasets": {"mine": mine}}, str(REPOSITORY)), "extract"
    )
    assert said == "scene one: the frame range (2, 11) ends beyond its 10 key frames"


@pytest.mark.parametrize("kind", ["npz", "ply", "pcd"])
def test_a_lidar_without_rings_and_elevations_is_refused_where_it_is_rendered(tmp_path, kind):
    drive = changed(sweeps=[{"lidar": "top", "timestamp": 0, "file": f"top/bare.{kind}"}])
    made = plan(tmp_path, {"one": drive})
    bare = tmp_path / f"one/top/bare.{kind}"
    assert refusal(made, "scans") is None, "a missing file is left to the stage"
    for name in ("x", "ring"):
        if kind == "npz":
            with zipfile.ZipFile(bare, "w") as arrays:
                arrays.writestr(f"{name}.npy", b"")
        elif kind == "pcd":
            bare.write_bytes(f"FIELDS x {name}\nPOINTS 0\nDATA ascii\nFIELDS ring".encode())
        else:
            bare.write_bytes(f"ply\nelement vertex 1\nproperty float {name}\nend_header\nproperty float ring".encode())
        said = refusal(Plan(made.config.model_dump(mode="json"), str(REPOSITORY)), "scans")
        assert (said is None) == (name == "ring")
        lacks = "LiDAR top: its returns have no rings and its beam_elevations are unknown"
        assert said is None or (said.startswith(f"scene one, {lacks}") and "give one of them" in said)


@pytest.mark.parametrize(
    "damaged",
    ["[]", "{", '{"frames": 3}', '{"frames": [{}]}', '{"cameras": {"front": []}}', '{"sweeps": [{"lidar": "a"}]}'],
)
def test_a_damaged_drive_is_left_to_its_reader(tmp_path, damaged):
    (tmp_path / "drive.json").write_text(damaged)
    assert outline(tmp_path, "1", "one") is None


def test_every_unfit_scene_is_named_up_to_a_few(tmp_path):
    names = ["a", "b", "c", "d", "e", "f"]
    made = plan(tmp_path, dict.fromkeys(names, changed(sweeps=[])))
    jobs = [SimpleNamespace(rule=SimpleNamespace(name="lidar_seed"), wildcards=SimpleNamespace(scene=n)) for n in names]
    with pytest.raises(ConfigError) as refused:
        made.recordings.refuse_unfit(jobs)
    assert re.findall(r"scene (\w)\b", str(refused.value)) == names[:4]
    assert str(refused.value).endswith(". 2 more scenes have such faults")


def test_a_world_that_only_gets_another_edit_keeps_its_tracks(tmp_path):
    world = {"dataroot": str(tmp_path / "world"), "scenes": ["w"], "world": {"key_frames": 8}}
    results = tmp_path / "results"
    made = Plan({"datasets": {"w": world}, "results_dir": str(results)}, str(REPOSITORY))
    stage = {"settings": json.loads(made.stage_settings("demo_world", "w")), "code": made.code("demo_world")}
    marker, scene = Path(made.config.datasets["w"].world_root, WORLD_MARKER), results / "w/scene.json"
    assert not made.recordings.has_same_world("w")
    for file, content in ((marker, {"provenance": {"stages": {"demo_world": stage}}}), (scene, {})):
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(content))
    assert made.recordings.has_same_world("w")
    stage["settings"]["edits"] = {"another": {"steps": []}}
    marker.write_text(json.dumps({"provenance": {"stages": {"demo_world": stage}}}))
    os.utime(marker, ns=(scene.stat().st_mtime_ns,) * 2)
    assert made.recordings.has_same_world("w")
    os.utime(scene, (1, 1))
    assert not made.recordings.has_same_world("w"), "the world was begun anew since"
    shutil.copystat(marker, scene)
    world["world"] = {"key_frames": 9}
    made = Plan({"datasets": {"w": world}, "results_dir": str(results)}, str(REPOSITORY))
    assert not made.recordings.has_same_world("w")


def test_images_that_exceed_the_required_gpu_memory_are_named_at_planning(tmp_path, capsys):
    """1,116 images of 3840x2160 in uint8: 27.8 GB."""
    frames = [{"camera": "front", "timestamp": 500_000 * i, "file": f"{i}.jpg"} for i in range(1116)]
    drive = changed(frames=frames, cameras={"front": {"width": 3840, "height": 2160}})
    everything = {"holdout": {"every_nth": 0, "last_block": 0}}
    card = {"device": {"kind": "cuda", "min_free_gb": 16}}
    made = plan(tmp_path, {"one": drive}, **everything, **card)
    assert made.recordings.image_gb("one") == pytest.approx(1116 * 3840 * 2160 * 3e-9)
    assert refusal(made, "extract", "train") is None
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("drivesplat: scene one: its training images take 27.8 GB of GPU memory, and ")
    assert "device.min_free_gb asks for 16 GB alone; set images.width, " in line
    assert made.recordings.training_mb(SimpleNamespace(scene="one")) == 16_000 + 27_770
    fitting = [{"images": {"width": 1920}}, {"device": {"kind": "cuda", "min_free_gb": 40}}, {"device": "cpu"}]
    for values in fitting:
        smaller = Plan({**made.config.model_dump(mode="json"), **values}, str(REPOSITORY))
        assert refusal(smaller, "train") is None
    assert refusal(made, "extract") is None
    assert not capsys.readouterr().err


def test_the_size_of_training_images_counts_cameras_ranges_and_the_hold_out(tmp_path):
    of_one = 1600 * 900 * 3e-9
    mine = {**MINE, "dataroot": str(tmp_path)}
    made = plan(tmp_path, {"one": DRIVE})
    assert made.recordings.image_gb("one") == pytest.approx(5 * of_one), "10 without the 5th and the last four"
    config = {**made.config.model_dump(mode="json"), "holdout": {"every_nth": 0, "last_block": 0}}
    for values, images in (
        ({}, 10),
        ({"cameras": ["front", "back"]}, 20),
        ({"cameras": ["front", "back"], "holdout": {**config["holdout"], "cameras": ["back"]}}, 10),
        ({"datasets": {"mine": {**mine, "frames": {"one": (2, 6)}}}}, 4),
        ({"images": {"width": 800}}, 10 / 4),
    ):
        found = Plan({**config, **values}, str(REPOSITORY)).recordings.image_gb("one")
        assert found == pytest.approx(images * of_one), values


def test_the_size_of_other_recordings_is_known_once_they_are_extracted(tmp_path):
    made = Plan({"datasets": {"n": {"scenes": ["a1"]}}, "results_dir": str(tmp_path)}, str(REPOSITORY))
    assert made.recordings.image_gb("a1") is None
    assert made.recordings.training_mb(SimpleNamespace(scene="a1")) == 16_000
    frames = [{"camera": "CAM_FRONT", "width": 1600, "height": 900}] * 40
    scene = {"frames": frames, "key_frame_timestamps": [500_000 * i for i in range(40)], "sweeps": []}
    (tmp_path / "a1").mkdir()
    (tmp_path / "a1/scene.json").write_text(json.dumps(scene))
    assert made.recordings.image_gb("a1") == pytest.approx(32 * 1600 * 900 * 3e-9), "without 4, 12, 20, 28 and 36 to 39"
