"""Poses of files, and the renderings along them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.shared_runs import CAR
from PIL import Image
from scipy.spatial.transform import Rotation

import drivesplat
from drivesplat.cli.__main__ import main
from drivesplat.drive.render_files import read_poses
from drivesplat.errors import RequestError
from drivesplat.io.video import Footage, read_footage
from drivesplat.readers.truth import DEPTH_UNITS_PER_METRE
from drivesplat.scene.rigid import rigid

CAMERA = "CAM_FRONT"
POSES = rigid(Rotation.from_euler("xyz", [[10, 20, 30], [0, 0, 90]], degrees=True).as_matrix(), np.eye(3)[:2] * 4.0)
TIMES = np.array([0.5, 1.0])


def written(path: Path, times: np.ndarray, poses: np.ndarray) -> Path:
    """A file of poses, of the format that its name says."""
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = [[time, *pose[:3, 3], *quat] for time, pose, quat in zip(times, poses, quats, strict=True)]
    if path.suffix == ".json":
        keys = [{"camera_to_world": (pose @ np.diag([1.0, -1, -1, 1])).ravel().tolist()} for pose in poses]
        path.write_text(json.dumps({"camera_path": keys, "fps": 1.0 / (times[1] - times[0])}))
    elif path.suffix == ".csv":
        lines = [",".join(map(repr, [row[0], *row[4:], *row[1:4]])) for row in rows]
        path.write_text("\n".join(["time,qx,qy,qz,qw,x,y,z", *lines]))
    else:
        path.write_text("\n".join(["# time x y z qx qy qz qw", "", *(" ".join(map(repr, row)) for row in rows)]))
    return path


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.json"])
def test_poses_are_read_as_they_were_written(name, tmp_path):
    found = read_poses(written(tmp_path / name, TIMES, POSES))
    np.testing.assert_allclose(found.poses, POSES, atol=1e-12)
    np.testing.assert_allclose(found.times - found.times[0], TIMES - TIMES[0])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "", "no pose"),
        ("a.txt", "0 0 0 0 0 0 0 1\n1 2 3\n", "line 2"),
        ("a.txt", "0 0 0 0 0 0 0 2\n", "length 1"),
        ("a.txt", "0 nan 0 0 0 0 0 1\n", "finite"),
        ("a.csv", "time,x,y\n0,0,0\n", "'z'"),
        ("a.csv", "time,x,y,z,qw,qx,qy,qz\n0,0,0,up,1,0,0,0\n", "line 2"),
        ("a.csv", "time,x,y,z,qw,qx,qy,qz\n0,0\n", "line 2"),
        ("a.json", "{", "camera path"),
        ("a.json", "[]", "camera path"),
        ("a.json", '{"camera_path": []}', "camera path"),
        ("a.json", '{"camera_path": [], "fps": 4}', "no pose"),
        ("a.json", '{"camera_path": [{"camera_to_world": [1, 2]}], "fps": 4}', "camera path"),
    ],
)
def test_what_is_no_pose_is_named_with_its_line(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(RequestError, match=words) as raised:
        read_poses(tmp_path / name)
    assert name in str(raised.value) and "\n" not in str(raised.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RequestError, match=r"none\.csv"):
        read_poses(tmp_path / "none.csv")


@pytest.mark.workflow
def test_the_command_writes_what_the_drive_renders(finished_run, tmp_path, capsys):
    street, out = finished_run.folder / "results/0001/street", tmp_path / "out"
    drive = drivesplat.open(street, "cpu")
    ego = np.stack([drive.ego_to_world(time) for time in TIMES])
    file = written(tmp_path / "ego.csv", TIMES, ego)
    own = ["--poses", str(file), "--camera", CAMERA, "--ego", "--out", str(out), "--device", "cpu"]
    assert main(["render", str(street), *own, "--outputs", "rgb,depth,instance"]) == 0
    assert "2 images" in capsys.readouterr().out
    record = json.loads((out / "render.json").read_text())
    view = drive.render(CAMERA, TIMES[1], ego_to_world=ego[1], outputs=["rgb", "depth", "instance"])
    images = {name: np.array(Image.open(out / path)) for name, path in record["frames"][1]["images"].items()}
    np.testing.assert_array_equal(images["rgb"], view.image)
    np.testing.assert_allclose(images["depth"] / DEPTH_UNITS_PER_METRE, view.depth.numpy().clip(max=255.9), atol=3e-3)
    np.testing.assert_array_equal(images["instance"] == record["objects"][CAR], view.instance.numpy() == 0)
    assert record["objects"] == {CAR: 1} and record["frames"][0]["time"] == 0.5


@pytest.mark.workflow
def test_the_camera_is_by_default_the_one_that_looks_ahead_and_a_film_has_the_rate_of_the_poses(
    finished_run, tmp_path, capsys
):
    street, times = finished_run.folder / "results/0001/street", np.array([0.5, 0.6, 0.72])
    drive = drivesplat.open(street, "cpu")
    ahead = np.stack([drive.camera_to_world(CAMERA, time) for time in times])
    file, film = written(tmp_path / "a.csv", times, ahead), tmp_path / "out.mp4"
    own = ["render", str(street), "--poses", str(file), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main([*own, "--film", str(film)]) == 0
    assert f"film: {film}" in capsys.readouterr().out
    assert json.loads((tmp_path / "out/render.json").read_text())["camera"] == CAMERA
    seen = drive.camera(CAMERA)
    assert read_footage(film) == Footage(3, seen.width // 2 * 2, seen.height // 2 * 2, round(2 / 0.22, 2))
    for changes, words in (
        ({"--outputs": "depth"}, "add rgb to the outputs"),
        ({"--poses": str(written(tmp_path / "b.csv", times[::-1], ahead))}, "b.csv: a film needs two or more poses"),
        ({"--poses": str(written(tmp_path / "c.csv", times[:1], ahead[:1]))}, "c.csv: a film needs two or more poses"),
    ):
        refused = [*own, *(word for pair in changes.items() for word in pair)]
        assert main([*refused, "--film", str(tmp_path / "no.mp4")]) == 1
        assert words in capsys.readouterr().err
    assert not (tmp_path / "no.mp4").exists()
    front, left = drive.recording.first_image(CAMERA)[1], Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turned = front.ego_to_world @ rigid(left, np.zeros(3)) @ front.camera_to_ego
    aside = replace(front, camera="CAM_LEFT", camera_to_world=turned)
    rig = replace(drive.recording, scene=replace(drive.scene, frames=(aside, front)))
    assert (rig.cameras, rig.front_camera) == (["CAM_LEFT", CAMERA], CAMERA)


@pytest.mark.workflow
@pytest.mark.parametrize("changes", [["--outputs", "boxes"], ["--camera", "CAM_X"], ["--poses", "none.txt"]])
def test_the_command_says_in_a_line_what_it_cannot_do(finished_run, changes, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "a.txt", TIMES, POSES)
    own = ["--poses", "a.txt", "--camera", CAMERA, "--out", "out", "--device", "cpu", *changes]
    assert main(["render", str(finished_run.folder / "results/0001/street"), *own]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert changes[1] in line
