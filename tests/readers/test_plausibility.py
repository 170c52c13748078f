"""Mistakes of a converter that leave a sound drive.json, and the sentence that each is warned of with."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drives import scene_at
from scipy.spatial.transform import Rotation

from drivesplat.poses import lens
from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.format import Pose
from drivesplat.readers.drive.poses import matrix_of
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.rigid import inverse, rigid

Content = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, tiny_root) -> Path:
    root = tmp_path_factory.mktemp("plausible") / "0001"
    write_drive(scene_at(tiny_root, lidar_sweeps=True), root)
    return root


@pytest.fixture(scope="module")
def content(folder) -> Content:
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


def said_of(content: Content, change: Callable[[Content], Any], folder: Path, capsys) -> tuple[int, str]:
    """What the checker says of a changed drive in the folder, and its exit status."""
    changed = copy.deepcopy(content)
    change(changed)
    whole = (folder / "drive.json").read_text()
    (folder / "drive.json").write_text(json.dumps(changed))
    try:
        status = main(["check", str(folder), "--picture", str(folder.parent / "check.png")])
    finally:
        (folder / "drive.json").write_text(whole)
    return status, capsys.readouterr().out


def xyzw(pose: Content) -> None:
    pose["rotation"] = [*pose["rotation"][1:], pose["rotation"][0]]


def each(poses: list[Content], change: Callable[[Content], None]) -> None:
    for pose in poses:
        change(pose)


def rolled(pose: Content, degrees: float) -> None:
    given = {key: pose[key] for key in ("translation", "rotation")}
    matrix = matrix_of(Pose.model_validate(given))
    matrix[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix() @ matrix[:3, :3]
    pose |= as_record(matrix)


def scaled(k: list[list[float]], factor: float) -> list[list[float]]:
    return [[value * factor for value in row] for row in k[:2]] + k[2:]


def test_what_images_say_against_intrinsics_is_a_warning(content, folder, capsys, monkeypatch):
    monkeypatch.setattr(lens, "lens_warnings", lambda scene: [f"{scene.name} looks distorted"])
    status, said = said_of(content, lambda drive: None, folder, capsys)
    assert status == 0 and f"warning: {folder.name} looks distorted\n" in said


def test_coefficients_of_another_model_are_a_fault(content, folder, capsys):
    """A polynomial of angles to pixels, given as `fisheye`."""
    coefficients = {"model": "fisheye", "coefficients": [339.749, -31.988, 48.275, -7.201]}
    status, said = said_of(
        content, lambda drive: drive["cameras"]["CAM_FRONT"].update(distortion=coefficients), folder, capsys
    )
    assert status == 1 and "camera CAM_FRONT: its distortion leaves no image without empty pixels" in said
    assert "probably those of another model" in said and said.endswith("1 fault\n")


def test_a_drive_without_mistakes_has_no_warnings(content, folder, capsys):
    status, said = said_of(content, lambda drive: None, folder, capsys)
    assert status == 0 and "warning" not in said, said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: each(d["ego_poses"], xyzw), "check that rotations of poses are w, x, y, z"),
        (lambda d: each(d["ego_poses"], lambda pose: rolled(pose, 90.0)), "the ego vehicle is tilted by"),
        (
            lambda d: [pose.update(rotation=[0.7071068, 0, 0, 0.7071068]) for pose in d["ego_poses"]],
            "degrees to its x axis",
        ),
        (
            lambda d: d["cameras"]["CAM_FRONT"]["sensor_to_ego"].update(rotation=[1, 0, 0, 0]),
            "its y axis, which points down in the image, is 90 degrees",
        ),
        (
            lambda d: d["cameras"]["CAM_FRONT"]["sensor_to_ego"].update(rotation=[0.5, 0.5, -0.5, -0.5]),
            "check that the axes of sensor_to_ego are x right, y down, z forward",
        ),
        (
            lambda d: each([lidar["sensor_to_ego"] for lidar in d["lidars"].values()], lambda pose: rolled(pose, 90.0)),
            "hardly any return lies near the ground",
        ),
        (
            lambda d: d["cameras"]["CAM_FRONT"]["sensor_to_ego"].update(translation=[90.0, 60.0, 90.0]),
            "no return of a LiDAR falls into its images",
        ),
        (
            lambda d: d["cameras"]["CAM_FRONT"].update(K=scaled(d["cameras"]["CAM_FRONT"]["K"], 1.0 / 0.75)),
            "K may belong to another image size",
        ),
    ],
    ids=[
        "poses with w last", "poses rolled", "poses turned", "camera axes", "a camera upside down", "LiDAR rolled",
        "camera far above", "K of another image size",
    ],
)  # fmt: skip
def test_a_mistake_is_a_warning_that_says_what_to_check(change, words, content, folder, capsys):
    status, said = said_of(content, change, folder, capsys)
    warnings = [line for line in said.splitlines() if line.startswith("warning: ")]
    assert status == 0 and any(words in line for line in warnings), said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda d: [pose.update(timestamp=pose["timestamp"] // 10**6) for pose in d["ego_poses"]],
            "ego_poses: timestamps are seconds, those of frames and sweeps microseconds; multiply them by 1e+06",
        ),
        (
            lambda d: [pose.update(timestamp=pose["timestamp"] * 1000) for pose in d["ego_poses"]],
            "ego_poses: timestamps are nanoseconds, those of frames and sweeps microseconds",
        ),
        (
            lambda d: [pose.update(timestamp=pose["timestamp"] * 1e-6) for pose in d["ego_poses"]],
            "timestamps are whole microseconds; from seconds: round(t * 1e6)",
        ),
        (
            lambda d: d["cameras"]["CAM_FRONT"]["sensor_to_ego"].update(translation=[1700.0, 0.0, 1500.0]),
            "cameras.CAM_FRONT: its translation is",
        ),
    ],
    ids=[
        "poses in seconds", "poses in nanoseconds", "seconds as decimals", "a mount in millimetres",
    ],
)  # fmt: skip
def test_a_wrong_unit_is_a_fault_that_names_the_cause_in_few_lines(change, words, content, folder, capsys):
    status, said = said_of(content, change, folder, capsys)
    assert status == 1 and words in said, said
    assert len(said.splitlines()) <= 8, said


def test_a_vehicle_that_reverses_all_the_time_is_told_so(content, folder, capsys):
    def reverse(drive: Content) -> None:
        times = [pose["timestamp"] for pose in drive["ego_poses"]]
        drive["ego_poses"] = [
            {**pose, "timestamp": time} for pose, time in zip(reversed(drive["ego_poses"]), times, strict=True)
        ]

    _, said = said_of(content, reverse, folder, capsys)
    assert "the ego vehicle moves backwards" in said
