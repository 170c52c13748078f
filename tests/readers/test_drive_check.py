"""What the checker of drive folders refuses, what it prints, and the mistakes of a converter that it warns of."""

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
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses import lens
from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.format import Pose
from drivesplat.readers.drive.poses import matrix_of
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.settings.config import load

pytestmark = pytest.mark.usefixtures("uncompared")

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
    said, *lines = capsys.readouterr().out.splitlines()
    assert said == f"format: drive folder, by {folder / 'drive.json'}"
    return status, lines


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
    for pose in (pose for track in drive["tracks"] for pose in track["poses"]):
        pose["timestamp"] += 3_600_000_000


def elsewhere(drive: Content) -> None:
    shift([(0, pose["translation"]) for track in drive["tracks"] for pose in track["poses"]], MUNICH)


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
    first, last = lines.index("settings to copy:"), next(i for i, line in enumerate(lines) if "mine.yaml" in line)
    return yaml.safe_load("\n".join(lines[first + 1 : last]))


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
    (taken := tmp_path / "check.png").mkdir()
    changed = copy.deepcopy(content)
    changed["frames"][0]["file"] = "images/none.png"
    status, lines = checked(changed, folder, capsys, taken)
    assert status == 1 and "is missing" in lines[0] and lines[1].startswith("check.png cannot be written there"), lines
    assert lines[1].endswith("--picture names another place")


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
    changed |= {"key_frames": content["key_frames"][:2], "sweeps": content["sweeps"][:2]}
    changed["frames"] = [{**frame, "camera": name} for name in names for frame in content["frames"][:3]]
    checked(changed, folder, capsys, tmp_path / "six.png")
    assert Image.open(tmp_path / "six.png").size == (1920, 4 * 360)


# Mistakes of a converter that leave a sound drive.json


@pytest.fixture(scope="module")
def plain(folder) -> Content:
    """The tiny drive as a person writes it, with ego poses and mounts, in a world whose north it does not follow."""
    drive = json.loads((folder / "drive.json").read_text())
    ego = {frame["timestamp"]: matrix_of(Pose.model_validate(frame["ego_to_world"])) for frame in drive["frames"]}
    mount = matrix_of(Pose.model_validate(drive["frames"][0]["camera_to_world"]))
    mount = inverse(ego[drive["frames"][0]["timestamp"]]) @ mount
    sweep = drive["sweeps"][2]
    nearest = ego[min(ego, key=lambda time: abs(time - sweep["timestamp"]))]
    lidar = inverse(nearest) @ matrix_of(Pose.model_validate(sweep["lidar_to_world"]))
    for record in (*drive["frames"], *drive["sweeps"]):
        for key in ("camera_to_world", "ego_to_world", "lidar_to_world"):
            record.pop(key, None)
    times = sorted(ego)
    step = ego[times[1]][:3, 3] - ego[times[0]][:3, 3]
    poses = {times[0] - times[1] + times[0]: -step, **dict.fromkeys(times, 0.0), 2 * times[-1] - times[-2]: step}
    drive["ego_poses"] = []
    for time, moved in sorted(poses.items()):
        pose = ego[min(max(time, times[0]), times[-1])].copy()
        pose[:3, 3] += moved
        drive["ego_poses"].append({"timestamp": time, **as_record(WORLD @ pose)})
    drive["cameras"]["CAM_FRONT"]["sensor_to_ego"] = as_record(mount)
    drive["lidars"]["LIDAR_TOP"]["sensor_to_ego"] = as_record(lidar)
    drive["tracks"] = []
    return drive


WORLD = rigid(Rotation.from_euler("zyx", [40.0, 2.0, -1.0], degrees=True).as_matrix(), np.array([5.0, -3.0, 1.0]))


def as_record(pose: np.ndarray) -> Content:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}


CAMERA, MOUNT = "cameras.CAM_FRONT", "cameras.CAM_FRONT.sensor_to_ego"
LIDAR = "lidars.LIDAR_TOP.sensor_to_ego"


def said_of(plain: Content, place: str, value: Any, folder: Path, capsys) -> tuple[int, list[str]]:
    """The checker's exit status, and what it says of the drive with another value at a place of the record: `value`, or
    what it makes of the one that is there."""
    changed = copy.deepcopy(plain)
    *way, last = place.split(".")
    holder = changed
    for key in way:
        holder = holder[key]
    holder[last] = value(holder[last]) if callable(value) else value
    return checked(changed, folder, capsys)


def timed(factor: float, divisor: int = 1) -> Callable[[list[Content]], list[Content]]:
    return each(lambda pose: {**pose, "timestamp": pose["timestamp"] * factor // divisor})


def rolled(pose: Content) -> Content:
    matrix = matrix_of(Pose.model_validate({key: pose[key] for key in ("translation", "rotation")}))
    matrix[:3, :3] = Rotation.from_euler("x", 90.0, degrees=True).as_matrix() @ matrix[:3, :3]
    return pose | as_record(matrix)


def w_last(pose: Content) -> Content:
    return {**pose, "rotation": [*pose["rotation"][1:], pose["rotation"][0]]}


def each(change: Callable[[Content], Content]) -> Callable[[list[Content]], list[Content]]:
    return lambda poses: [change(pose) for pose in poses]


def reversing(poses: list[Content]) -> list[Content]:
    return [{**pose, "timestamp": at["timestamp"]} for pose, at in zip(reversed(poses), poses, strict=True)]


def of_larger_images(k: list[list[float]]) -> list[list[float]]:
    return [[value / 0.75 for value in row] for row in k[:2]] + k[2:]


def test_a_drive_without_mistakes_has_the_warnings_of_its_images_alone(plain, folder, capsys, monkeypatch):
    monkeypatch.setattr(lens, "lens_warnings", lambda scene: [f"{scene.name} looks distorted"])
    status, said = said_of(plain, "tracks", [], folder, capsys)
    warnings = [line for line in said if line.startswith("warning")]
    assert status == 0 and warnings == [f"warning: {folder.name} looks distorted"]


MISTAKES = {
    "poses with w last": ("ego_poses", each(w_last), "check that rotations of poses are w, x, y, z"),
    "poses rolled": ("ego_poses", each(rolled), "the ego vehicle is tilted by"),
    "poses turned": (
        "ego_poses", each(lambda pose: {**pose, "rotation": [0.7071068, 0, 0, 0.7071068]}), "degrees to its x axis",
    ),
    "poses backwards": ("ego_poses", reversing, "the ego vehicle moves backwards"),
    "camera axes": (
        f"{MOUNT}.rotation", [1, 0, 0, 0], "its y axis, which points down in the image, is 90 degrees",
    ),
    "a camera upside down": (
        f"{MOUNT}.rotation", [0.5, 0.5, -0.5, -0.5],
        "check that the axes of sensor_to_ego are x right, y down, z forward",
    ),
    "LiDAR rolled": (LIDAR, rolled, "hardly any return lies near the ground"),
    "camera far above": (
        f"{MOUNT}.translation", [90.0, 60.0, 90.0], "no return of a LiDAR falls into its images",
    ),
    "K of another image size": (f"{CAMERA}.K", of_larger_images, "K may belong to another image size"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_a_warning_that_says_what_to_check(mistake, plain, folder, capsys):
    place, value, words = MISTAKES[mistake]
    status, said = said_of(plain, place, value, folder, capsys)
    warnings = [line for line in said if line.startswith("warning: ")]
    assert status == 0 and any(words in line for line in warnings), said


FAULTS = {
    "poses in seconds": (
        "ego_poses", timed(1, 10**6),
        "ego_poses: timestamps are seconds, those of frames and sweeps microseconds; multiply them by 1e+06",
    ),
    "poses in nanoseconds": (
        "ego_poses", timed(1000), "ego_poses: timestamps are nanoseconds, those of frames and sweeps microseconds",
    ),
    "seconds as decimals": (
        "ego_poses", each(lambda pose: {**pose, "timestamp": pose["timestamp"] * 1e-6}),
        "timestamps are whole microseconds; from seconds: round(t * 1e6)",
    ),
    "a mount in millimetres": (f"{MOUNT}.translation", [1700.0, 0.0, 1500.0], "cameras.CAM_FRONT: its translation is"),
    "a polynomial of pixels as fisheye": (
        f"{CAMERA}.distortion", {"model": "fisheye", "coefficients": [339.749, -31.988, 48.275, -7.201]},
        "probably those of another model",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_unit_or_model_is_a_fault_that_names_the_cause_in_few_lines(fault, plain, folder, capsys):
    place, value, words = FAULTS[fault]
    status, said = said_of(plain, place, value, folder, capsys)
    assert status == 1 and any(words in line for line in said) and len(said) <= 8, said
