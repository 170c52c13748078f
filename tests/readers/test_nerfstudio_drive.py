"""A transforms.json of nerfstudio as a drive folder: cameras, units, times, and values that cannot be."""

import copy
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hand_made import recording_of
from helpers.mutations import damages, fresh, mutate_bytes, mutate_json, mutate_words
from helpers.shown_drives import require_refused_or_sound
from helpers.table_files import time_limit
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.export.camera_files import transforms_record
from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse, rigid

STATED = ["--metres-per-unit", "1", "--seconds-per-time", "1e-6", "--camera-height", "1.5"]


def converted(values: Any, folder: Path, arguments: list[str] | None = None) -> int:
    """Writes the file beside images and runs the command on it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(values), encoding="utf-8")
    command = ["from-nerfstudio", str(folder / "transforms.json"), str(folder / "out")]
    return main([*command, *(STATED if arguments is None else arguments)])


def scene_in(folder: Path):
    assert check(folder / "out", None) == []
    return whole_scene(read_drive(folder / "out"), folder / "out")


def test_an_exported_scene_is_read_back(tiny_scene, tiny_root, tmp_path):
    values = json.loads(json.dumps(transforms_record(tiny_scene, recording_of(tiny_scene).record)))
    (tmp_path / "images").symlink_to(tiny_root)
    assert converted(values, tmp_path) == 0
    scene = scene_in(tmp_path)
    recorded = sorted(tiny_scene.frames, key=lambda frame: frame.timestamp)
    assert [frame.timestamp for frame in scene.frames] == [frame.timestamp for frame in recorded]
    assert [camera.name for camera in scene.cameras] == ["CAM_FRONT"]
    for frame, other in zip(scene.frames, recorded, strict=True):
        np.testing.assert_allclose(frame.intrinsics, other.intrinsics, atol=1e-9)
        pose = rigid(frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3] + scene.origin)
        np.testing.assert_allclose(pose, other.camera_to_world, atol=1e-9)
        assert Path(frame.image_path).read_bytes() == Path(other.image_path).read_bytes()
        np.testing.assert_allclose(frame.ego_to_world[:3, :3], other.ego_to_world[:3, :3], atol=1e-9)
        assert frame.ego_to_world[2, 3] + scene.origin[2] == pytest.approx(0.0, abs=1e-9), "on the ground"


SIZE = (80, 60)
UPRIGHT = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""An OpenGL camera that looks along x, with z up: its columns are right, up, back."""


@pytest.fixture
def folder(tmp_path) -> Path:
    """Four images of two folders, with a turning rig, at 10 Hz."""
    for camera in ("left", "right"):
        (tmp_path / "images" / camera).mkdir(parents=True)
        for number in range(4):
            Image.new("RGB", SIZE, (60 * number, 90, 120)).save(tmp_path / f"images/{camera}/{number}.png")
    return tmp_path


def rig(number: float) -> np.ndarray:
    """Rig to world (4, 4), in metres."""
    return rigid(Rotation.from_euler("z", 0.05 * number + 0.7).as_matrix(), np.array([3.0 + number, 2.0, 4.0]))


MOUNTS = {
    "left": rigid(Rotation.from_euler("zy", [0.0, 0.04]).as_matrix() @ UPRIGHT, np.array([0.0, 0.3, 1.5])),
    "right": rigid(Rotation.from_euler("zy", [-0.8, 0.0]).as_matrix() @ UPRIGHT, np.array([0.2, -0.3, 1.6])),
}


@pytest.fixture
def values() -> dict[str, Any]:
    """A file in half metres, with times in seconds."""
    frames = [
        {
            "file_path": f"./images/{camera}/{number}.png", "time": 100.0 + 0.1 * number,
            "transform_matrix": in_half_metres(rig(number) @ mount),
        }
        for number in range(4)
        for camera, mount in MOUNTS.items()
    ]  # fmt: skip
    intrinsics = {"fl_x": 70.0, "fl_y": 72.0, "cx": 41.0, "cy": 29.5, "w": 80, "h": 60}
    return {"camera_model": "OPENCV", **intrinsics, "frames": frames}


def in_half_metres(pose: np.ndarray) -> list[list[float]]:
    return rigid(pose[:3, :3], 2.0 * pose[:3, 3]).tolist()


HALF_METRES = ["--metres-per-unit", "0.5", "--seconds-per-time", "1", "--camera-height", "1.5"]


def by_nerfstudio(values: dict[str, Any], frame: dict[str, Any], point: np.ndarray) -> np.ndarray:
    """The pixel of a world point in metres, from the image's corner, as nerfstudio's documentation says: the camera
    looks along -z, y is up."""
    pose = np.array(frame["transform_matrix"])
    x, y, z = pose[:3, :3].T @ (2.0 * point - pose[:3, 3])
    return np.array([values["cx"] + values["fl_x"] * x / -z, values["cy"] - values["fl_y"] * y / -z])


def test_units_times_and_folders(folder, values):
    assert converted(values, folder, HALF_METRES) == 0
    scene = scene_in(folder)
    assert [camera.name for camera in scene.cameras] == ["left", "right"]
    assert [frame.timestamp for frame in scene.frames] == [100_000_000 + 100_000 * i for i in range(4)] * 2
    for entry, (camera, number) in zip(values["frames"], [(c, n) for n in range(4) for c in MOUNTS], strict=True):
        frame = next(f for f in scene.frames if f.camera == camera and f.timestamp % 10**6 == 10**5 * number)
        point = frame.camera_to_world[:3, 3] + scene.origin + frame.camera_to_world[:3, :3] @ [1.0, 0.5, 8.0]
        pixels, _ = project(
            point[None] - scene.origin, inverse(frame.camera_to_world), continuous_intrinsics(frame, SIZE)
        )
        np.testing.assert_allclose(pixels[0], by_nerfstudio(values, entry, point), atol=1e-6)
        np.testing.assert_allclose(
            frame.camera_to_world[:3, 3] + scene.origin, (rig(number) @ MOUNTS[camera])[:3, 3], atol=1e-9
        )
    assert scene.frames[0].intrinsics[0, 2] == 40.5 and scene.frames[0].intrinsics[1, 2] == 29.0
    for number, frame in enumerate(scene.frames):
        expected = rig(number % 4) @ rigid(np.eye(3), np.array([0.0, 0.3, 0.0]))
        expected[:3, 3] -= scene.origin
        np.testing.assert_allclose(frame.ego_to_world, expected, atol=1e-9), "level below the camera that looks ahead"


def test_files_without_times_take_the_rate_of_their_images(folder, values, capsys):
    """Names count from 9 to 12, and frames stand in another order."""
    for camera in MOUNTS:
        for number in range(4):
            image = folder / f"images/{camera}/{number}.png"
            image.rename(image.with_name(f"frame_{number + 9}.png"))
    with_times = json.loads(json.dumps(values))
    for frame in values["frames"]:
        path, _, number = frame["file_path"][:-4].rpartition("/")
        frame["file_path"] = f"{path}/frame_{int(number) + 9}.png"
        del frame["time"]
    values["frames"].reverse()
    without_unit = ["--metres-per-unit", "0.5", "--camera-height", "1.5"]
    assert converted(values, folder, without_unit) == 1
    assert "frames[0] has no timestamp" in (said := capsys.readouterr().err) and "state --hz where" in said
    for hz, words in (("0", "a positive number, not 0: --hz"), ("nan", "not nan: --hz"), ("-3", "not -3: --hz")):
        assert converted(values, folder, [*without_unit, "--hz", hz]) == 1
        assert words in capsys.readouterr().err
    assert converted(with_times, folder, [*without_unit, "--hz", "4"]) == 1
    assert "its frames have a time; leave out --hz" in capsys.readouterr().err
    assert converted(values, folder, [*without_unit, "--hz", "4"]) == 0
    scene = scene_in(folder)
    assert {frame.camera for frame in scene.frames} == set(MOUNTS)
    for camera in MOUNTS:
        of_camera = [frame for frame in scene.frames if frame.camera == camera]
        assert [frame.timestamp for frame in of_camera] == [0, 250_000, 500_000, 750_000]
        for number, frame in enumerate(of_camera):
            place = frame.camera_to_world[:3, 3] + scene.origin
            np.testing.assert_allclose(place, (rig(number) @ MOUNTS[camera])[:3, 3], atol=1e-9)


def test_an_image_that_is_a_pipe_is_refused(folder, values, capsys):
    (folder / "images/left/2.png").unlink()
    os.mkfifo(folder / "images/left/2.png")
    with time_limit():
        assert converted(values, folder, HALF_METRES) == 1
    assert "2.png cannot be read (it is not a file)" in capsys.readouterr().err


def test_rounding_of_poses_is_accepted_and_removed(folder, values):
    for frame in values["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 3).tolist()
    assert converted(values, folder, HALF_METRES) == 0
    for frame in scene_in(folder).frames:
        turn = frame.camera_to_world[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)


def test_cameras_that_fire_at_other_times_are_mounted_where_they_are(folder, values):
    """The right camera begins 0.24 s later; the left one's motion says where the vehicle is then."""
    values["frames"] = [f for f in values["frames"] if "/left/" in f["file_path"] or f["time"] > 100.15]
    for frame in values["frames"]:
        if "/right/" in frame["file_path"]:
            number = round((frame["time"] - 100.0) * 10)
            pose = in_half_metres(rig(number + 0.4) @ MOUNTS["right"])
            frame |= {"time": frame["time"] + 0.04, "transform_matrix": pose}
    assert converted(values, folder, HALF_METRES) == 0
    scene = scene_in(folder)
    for frame in [frame for frame in scene.frames if frame.camera == "right"]:
        number = (frame.timestamp - 100_000_000) / 1e5
        expected = rig(number) @ rigid(np.eye(3), np.array([0.0, 0.3, 0.0]))
        np.testing.assert_allclose(frame.ego_to_world[:3, :3], expected[:3, :3], atol=1e-9)
        np.testing.assert_allclose(frame.ego_to_world[:3, 3] + scene.origin, expected[:3, 3], atol=1e-4)


@pytest.mark.parametrize(
    ("model", "given", "expected", "coefficients"),
    [
        ("OPENCV", {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}, "opencv", [-0.1, 0.02, 0.001, -0.002, 0.0]),
        ("OPENCV", {"k1": -0.1, "k3": 0.003}, "opencv", [-0.1, 0.0, 0.0, 0.0, 0.003]),
        ("OPENCV_FISHEYE", {"k1": 0.03, "k2": 0.005, "k3": 6e-4, "k4": 1e-4}, "fisheye", [0.03, 0.005, 6e-4, 1e-4]),
        ("OPENCV_FISHEYE", {}, "fisheye", [0.0, 0.0, 0.0, 0.0]),
        ("PINHOLE", {}, "none", []),
    ],
)
def test_distortion_is_that_of_opencv(model, given, expected, coefficients, folder, values):
    """At the top, or of each frame."""
    values["camera_model"] = model
    for holder in [values] if "k2" in given else values["frames"]:
        holder.update(given)
    assert converted(values, folder, HALF_METRES) == 0
    distortion = read_drive(folder / "out").cameras["left"].distortion
    assert (distortion.model, list(distortion.coefficients)) == (expected, coefficients)


def test_an_applied_transform_is_undone_where_asked_for(folder, values, capsys):
    """The world before it has y down, as COLMAP's."""
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    values["applied_transform"] = applied.tolist()
    for frame in values["frames"]:
        frame["file_path"] = "../" + frame["file_path"]
    assert converted(values, folder / "as_it_is", HALF_METRES) == 0
    assert converted(values, folder / "undone", [*HALF_METRES, "--undo-applied-transform"]) == 1
    assert "z must be up: rotate transform_matrix, or leave out --undo-applied-transform" in capsys.readouterr().err
    for frame in values["frames"]:
        pose = np.array(frame["transform_matrix"])
        frame["transform_matrix"] = (np.vstack([applied, [0, 0, 0, 1]]) @ pose).tolist()
    assert converted(values, folder / "lying", HALF_METRES) == 1
    assert "or try --undo-applied-transform" in capsys.readouterr().err
    assert converted(values, folder / "undone_again", [*HALF_METRES, "--undo-applied-transform"]) == 0
    values["applied_transform"] = "x"
    assert converted(values, folder / "text", [*HALF_METRES, "--undo-applied-transform"]) == 1
    assert "applied_transform: its transform is 'x'" in capsys.readouterr().err
    for one, other in zip(scene_in(folder / "undone_again").frames, scene_in(folder / "as_it_is").frames, strict=True):
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=1e-9)


def test_what_is_left_out_is_said(folder, values, capsys):
    values |= {"ply_file_path": "points.ply", "train_filenames": [], "camera_model": "OPENCV_FISHEYE", "p1": -6e-5}
    values["frames"][0]["mask_path"] = "masks/0.png"
    assert converted(values, folder, HALF_METRES) == 0
    said = capsys.readouterr().out
    for words in ("no LiDAR sweeps", "mask_path of 1 frames", "train_filenames", "p1 and p2 are not used"):
        assert words in said
    assert "no LiDAR" in said


def refusal_of(values: Any, folder: Path, arguments: list[str], capsys) -> str:
    """The line that refuses a file and leaves no drive."""
    assert converted(values, folder, arguments) == 1
    said = capsys.readouterr().err
    assert said.startswith("drivesplat: ") and said.count("\n") == 1 and not list((folder / "out").rglob("*.json"))
    return said


def test_what_the_file_does_not_say_must_be_stated(folder, values, capsys):
    metres, seconds, height = HALF_METRES[:2], HALF_METRES[2:4], HALF_METRES[4:]
    for arguments, words in (
        ([*seconds, *height], "state --metres-per-unit"),
        ([*metres, *height], "state --seconds-per-time"),
        ([*metres, *seconds], "state --camera-height"),
        (["--metres-per-unit", "0", *seconds, *height], "it must be a positive number, not 0"),
        (["--metres-per-unit", "nan", *seconds, *height], "it must be a positive number, not nan"),
        ([*metres, "--seconds-per-time", "1e300", *height], "check --seconds-per-time"),
        ([*metres, "--seconds-per-time", "1e-6", *height], "it has the time of frames[0]"),
        ([*HALF_METRES, "--ego-camera", "front"], "no camera 'front'; there are: left, right"),
    ):
        assert words in refusal_of(values, folder, arguments, capsys)


LOOKS_DOWN = rigid(UPRIGHT @ Rotation.from_euler("x", np.radians(-80.0)).as_matrix(), np.zeros(3)).tolist()
EVERY, LEFT, ABSENT = slice(None), slice(0, None, 2), object()
FAULTS = [
    (None, {"frames": []}, "has no frames"),
    (3, {"time": ABSENT}, "frames[0] has no timestamp and not all frames have a time"),
    (3, {"time": -1.0}, "frames[3]: its time is -1.0"),
    (None, {"fl_y": ABSENT}, "frames[0] has no fl_y, and neither has the top"),
    (None, {"fl_x": 1e-3}, "its focal length is 0.001 pixels"),
    (None, {"w": 160}, "is 80x60, its w and h say 160x60"),
    (1, {"file_path": "images/none.png"}, "none.png is missing"),
    (1, {"file_path": "images"}, "cannot be read"),
    (2, {"transform_matrix": ABSENT}, "frames[2]: its transform is None"),
    (2, {"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "transform mirrors"),
    (2, {"transform_matrix": (-np.diag([1.0, 1, 1, -1])).tolist()}, "transform mirrors"),
    (2, {"transform_matrix": rigid(UPRIGHT, np.ones(3)).T.tolist()}, "it seems to be transposed"),
    (2, {"transform_matrix": rigid(UPRIGHT, np.array([2e8, 0, 0])).tolist()}, "at most 1e+08"),
    (2, {"transform_matrix": np.diag([1.0, 0.5, 2, 1]).tolist()}, "is not rigid"),
    (2, {"transform_matrix": [[True] * 4] * 4}, "4x4"),
    (2, {"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, "is not rigid"),
    (EVERY, {"transform_matrix": np.eye(4).tolist()}, "z must be up"),
    (LEFT, {"transform_matrix": LOOKS_DOWN}, "left looks up or down; name one that looks ahead with --ego-camera"),
    (None, {"camera_model": "EQUIRECTANGULAR"}, "its camera_model is 'EQUIRECTANGULAR'"),
    (None, {"k4": 0.1}, "nerfstudio's k4 is no coefficient of OpenCV's model"),
    (None, {"k1": -3.0}, "its distortion folds"),
    (EVERY, {"camera": "x"}, "it has the time of frames[0], of the same camera x"),
]
"""Changes of the top, or of some frames."""


@pytest.mark.parametrize(("where", "change", "words"), FAULTS)
def test_values_that_cannot_be_are_a_sentence(where, change, words, folder, values, capsys):
    frames = values["frames"]
    for holder in [values] if where is None else frames[where] if isinstance(where, slice) else [frames[where]]:
        holder |= copy.deepcopy({name: value for name, value in change.items() if value is not ABSENT})
        for name in [name for name, value in change.items() if value is ABSENT]:
            del holder[name]
    assert words in refusal_of(values, folder, HALF_METRES, capsys)


def test_a_camera_has_one_lens(folder, values, capsys):
    del values["cx"]
    for i, frame in enumerate(values["frames"]):
        frame |= {"camera": "x", "cx": 40.0 + i}
    words = "frames[1]: its intrinsics are not those of frames[0], of the same camera x"
    assert words in refusal_of(values, folder, HALF_METRES, capsys)


def test_what_is_no_json_is_a_sentence(folder, capsys):
    assert "has no frames" in refusal_of([1], folder, STATED, capsys)
    path = folder / "transforms.json"
    command = ["from-nerfstudio", str(path), str(folder / "out"), *STATED]
    for text in ("", "{", "[" * 200_000, "\ud800"):
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        assert main(command) == 1 and "is not JSON" in capsys.readouterr().err
    path.unlink()
    assert main(command) == 1 and "transforms.json is missing" in capsys.readouterr().err
    os.mkfifo(path)
    with time_limit():
        assert main(command) == 1
    assert "transforms.json is not a file" in capsys.readouterr().err


@damages(20, 200)
def test_damaged_files_are_refused_in_one_line_or_sound(folder, values, capsys, random):
    """Damage to a value, a word or a byte of a file with a lens and an applied transform, with times or without."""
    content = copy.deepcopy(values) | {"k1": 0.01, "applied_transform": np.eye(4)[:3].tolist()}
    rate = random.choice(["--hz", "--seconds-per-time"])
    for i, frame in enumerate(content["frames"]):
        frame |= {"camera_id": 1} if i % 2 else {}
        if rate == "--hz":
            del frame["time"]
    damage = random.choice([mutate_json, mutate_json, mutate_words, mutate_bytes])
    if damage is mutate_json:
        content = mutate_json(random, content, inwards=9)
    path = folder / "transforms.json"
    path.write_text(json.dumps(content, indent=random.choice([None, 1])))
    done = "a value" if damage is mutate_json else damage(random, path)
    stated = [*HALF_METRES[:2], rate, "1" if rate == "--seconds-per-time" else "10", *HALF_METRES[4:]]
    undo = random.choice([[], ["--undo-applied-transform"]])
    with fresh(folder) as out:
        command = ["from-nerfstudio", str(path), str(out / "out"), *stated, *undo]
        require_refused_or_sound(lambda: main(command), out / "out", capsys, done)
