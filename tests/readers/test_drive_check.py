"""What the checker of drive folders refuses, and what it prints."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.drives import scene_at
from PIL import Image

from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.write import write_drive
from drivesplat.settings.config import load

Content = dict[str, Any]
MUNICH = np.array([691607.8, 5335742.3, 519.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory, tiny_root) -> Path:
    root = tmp_path_factory.mktemp("checked") / "0001"
    write_drive(scene_at(tiny_root, lidar_sweeps=True), root)
    return root


@pytest.fixture(scope="module")
def content(folder) -> Content:
    return json.loads((folder / "drive.json").read_text(encoding="utf-8"))


def checked(content: Content, folder: Path, capsys, picture: Path | None = None) -> tuple[int, list[str]]:
    """The exit status and the lines of the checker for other content of a folder."""
    whole = (folder / "drive.json").read_text(encoding="utf-8")
    (folder / "drive.json").write_text(json.dumps(content), encoding="utf-8")
    try:
        status = main(["check", str(folder), *(["--picture", str(picture)] if picture else [])])
    finally:
        (folder / "drive.json").write_text(whole, encoding="utf-8")
    return status, capsys.readouterr().out.splitlines()


def places(drive: Content) -> list[tuple[int, list[float]]]:
    """The times and positions of all poses in the world."""
    found = [
        (record["timestamp"], record[key]["translation"])
        for record in (*drive["frames"], *drive["sweeps"])
        for key in ("camera_to_world", "ego_to_world", "lidar_to_world")
        if record.get(key)
    ]
    return found + [(pose["timestamp"], pose["translation"]) for track in drive["tracks"] for pose in track["poses"]]


def shift(found: list[tuple[int, list[float]]], by: np.ndarray, since: int = 0) -> None:
    for time, place in found:
        if time >= since:
            place[:] = (np.array(place) + by).tolist()


def global_and_origin(drive: Content) -> None:
    shift(places(drive), MUNICH)
    drive["origin"] = MUNICH.tolist()


def other_zone(drive: Content) -> None:
    times = sorted(frame["timestamp"] for frame in drive["frames"])
    shift(places(drive), MUNICH)
    shift(places(drive), np.array([-430_000.0, 0.0, 0.0]), times[len(times) // 2])
    drive.pop("origin", None)


def hour_late(drive: Content) -> None:
    for track in drive["tracks"]:
        for pose in track["poses"]:
            pose["timestamp"] += 3_600_000_000


def elsewhere(drive: Content) -> None:
    for track in drive["tracks"]:
        shift([(0, pose["translation"]) for pose in track["poses"]], MUNICH)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (global_and_origin, "origin: poses are relative to it, yet the first one lies 5380 km away"),
        (other_zone, "has the UTM zone changed"),
        (hour_late, "none has a pose during the drive"),
        (elsewhere, "their poses must be in the world of ego_poses"),
    ],
)
def test_a_drive_in_two_places_or_times_is_refused_in_one_line(change: Callable, words, content, folder, capsys):
    changed = copy.deepcopy(content)
    assert changed["tracks"]
    change(changed)
    status, lines = checked(changed, folder, capsys)
    assert status == 1 and words in lines[0] and lines[1:] == ["1 fault"], lines


def test_an_ego_vehicle_that_jumps_is_one_warning(content, folder, capsys):
    changed = copy.deepcopy(content)
    times = sorted(frame["timestamp"] for frame in changed["frames"])
    shift(places(changed), np.array([5000.0, 0.0, 0.0]), times[len(times) // 2])
    _, lines = checked(changed, folder, capsys)
    assert sum("jumps" in line for line in lines) == 1, lines


def settings_in(lines: list[str]) -> Content:
    return yaml.safe_load("\n".join(lines[lines.index("settings to copy:") + 1 :]))


def test_the_settings_that_it_ends_with_are_taken(content, folder, capsys):
    status, lines = checked(content, folder, capsys)
    settings = settings_in(lines)
    assert status == 0 and load(settings).datasets["mine"].scenes == ("0001",)
    assert Path(settings["datasets"]["mine"]["dataroot"]) == folder
    assert settings["cameras"] == ["CAM_FRONT"] and settings["eval_camera"] == "CAM_FRONT"
    assert not {"images", "render", "lidar_seed"} & set(settings)


def test_a_short_drive_without_lidar_gets_the_settings_that_it_needs(content, folder, capsys):
    changed = {**content, "sweeps": [], "lidars": {}, "tracks": [], "key_frames": content["key_frames"][:3]}
    changed["frames"] = [one for one in content["frames"] if one["timestamp"] <= content["key_frames"][2] + 10]
    status, lines = checked(changed, folder, capsys)
    settings = settings_in(lines)
    load(settings)
    assert status == 0 and settings["lidar_seed"] == {"on_missing": "warn"}
    assert settings["holdout"]["last_block"] == 1, "the default holds out all of three key frames"
    assert not any("surfaces" in line or "boxes around" in line for line in lines)


def test_a_picture_that_cannot_be_written_is_one_sentence_after_the_faults(content, folder, tmp_path, capsys):
    taken = tmp_path / "check.png"
    taken.mkdir()
    status, lines = checked(content, folder, capsys, taken)
    assert status == 0 and lines[0].startswith("check.png cannot be written there")
    assert lines[0].endswith("--picture names another place")
    changed = copy.deepcopy(content)
    changed["frames"][0]["file"] = "images/none.png"
    status, lines = checked(changed, folder, capsys, taken)
    assert status == 1 and "is missing" in lines[0] and lines[1].startswith("check.png cannot"), lines


def test_a_fault_of_many_images_is_one_line_with_their_number(content, folder, tmp_path, capsys):
    for frame in content["frames"]:
        path = tmp_path / frame["file"]
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((54, 96), 40_000, dtype=np.uint16)).save(path, format="PNG")
    without = {**content, "sweeps": [], "lidars": {}}
    (tmp_path / "drive.json").write_text(json.dumps(without), encoding="utf-8")
    assert main(["check", str(tmp_path)]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if "more than 8 bits" in line]
    assert len(lines) == 1 and lines[0].endswith(f"({len(content['frames']) - 1} other images the same)")


def test_six_cameras_are_drawn_in_a_grid(content, folder, tmp_path, capsys):
    names = [f"camera {i}" for i in range(6)]
    changed = {**content, "cameras": dict.fromkeys(names, content["cameras"]["CAM_FRONT"]), "tracks": []}
    changed["frames"] = [{**frame, "camera": name} for name in names for frame in content["frames"]]
    checked(changed, folder, capsys, tmp_path / "six.png")
    assert Image.open(tmp_path / "six.png").size == (1920, 4 * 360)
