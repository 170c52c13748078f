"""Bags of ROS as drive folders: all containers, a drive that was written as MCAP, and what the map decides."""

import json
import shutil
import sqlite3
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.bags import (
    CAMERA,
    CLOUD,
    CONTAINERS,
    IMAGE,
    INFO,
    LENS,
    LIDAR,
    OUSTER,
    START,
    WALL,
    K,
    Messages,
    TestBag,
    ego,
    imported,
    jpeg,
)  # fmt: skip
from scipy.spatial.transform import Rotation

from drivesplat.cli.__main__ import main
from drivesplat.export.drive_mcap import write_mcap
from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import Drive, read_drive
from drivesplat.readers.drive.poses import matrix_of
from drivesplat.readers.drive.write import write_drive, write_sweep
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply, rigid
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import LidarReturns


def drive_in(folder: Path) -> Drive:
    assert check(folder / "out", None) == []
    return read_drive(folder / "out")


def scene_in(folder: Path) -> Scene:
    return whole_scene(drive_in(folder), folder / "out")


@pytest.mark.parametrize("container", CONTAINERS)
def test_bags_of_every_container_become_the_same_drive(container, tmp_path, capsys):
    path = TestBag.recorded(ros1=container == "ros1").write(tmp_path, container)
    assert imported(path, tmp_path) == 0
    drive, scene = drive_in(tmp_path), scene_in(tmp_path)
    stamps = [START + 100_000 * i for i in range(10)]
    assert [frame.timestamp for frame in drive.frames] == [sweep.timestamp for sweep in drive.sweeps] == stamps
    camera, lidar = drive.cameras["front"], drive.lidars["top"]
    assert tuple(map(tuple, K)) == camera.K and camera.distortion.coefficients == tuple(LENS)
    assert not lidar.motion_compensated and lidar.revolution_s == 0.1
    np.testing.assert_allclose(matrix_of(camera.sensor_to_ego), CAMERA, atol=1e-9)
    np.testing.assert_allclose(matrix_of(lidar.sensor_to_ego), LIDAR, atol=1e-9)
    for number, frame in enumerate(scene.frames):
        assert Path(frame.image_path).read_bytes() == jpeg(number), "the bytes of the JPEG"
        expected = ego(frame.timestamp)
        np.testing.assert_allclose(frame.ego_to_world[:3, 3] + scene.origin, expected[:3, 3], atol=2e-4)
        np.testing.assert_allclose(frame.ego_to_world[:3, :3], expected[:3, :3], atol=1e-6)
    for sweep in scene.sweeps:
        returns = read_returns(sweep)
        points = apply(sweep.sensor_to_world, returns.points) + scene.origin
        np.testing.assert_allclose(points, WALL, atol=2e-3, err_msg="compensated by the times of points")
        np.testing.assert_array_equal(returns.rings, np.arange(len(WALL)) % 4)
        np.testing.assert_allclose(returns.intensity, np.arange(len(WALL)) % 200 / 255, atol=1e-6)
    assert "note:" not in capsys.readouterr().out


def test_old_and_split_bags_are_read(tmp_path):
    """ROS 2 before Iron stored no definitions of messages; a folder may have lost its metadata.yaml."""
    path = TestBag.recorded(seconds=0.3).write(tmp_path, "sqlite")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert imported(path, tmp_path) == 0
    assert len(drive_in(tmp_path).frames) == 3
    parts = tmp_path / "parts"
    parts.mkdir()
    for name, begin, end in (("0", -(10**6), 150_000), ("1", 150_000, 10**6)):
        bag = TestBag.recorded(seconds=0.3)
        bag.messages = [one for one in bag.messages if begin <= one[1] - START < end]
        (tmp_path / name).mkdir()
        shutil.copy(bag.write(tmp_path / name), parts / f"drive_{name}.mcap")
    (tmp_path / "out").rename(tmp_path / "first")
    assert imported(parts, tmp_path) == 0
    assert [frame.timestamp - START for frame in drive_in(tmp_path).frames] == [0, 100_000, 200_000]


def test_sweeps_longer_than_their_interval(tmp_path):
    """Points span 0.106 s at 10 Hz: the proposed revolution has room for them."""

    def longer(message: Any) -> Any:
        rows = message.data.view(OUSTER).copy()
        rows["t"] = rows["t"] * 1.07
        message.data = np.frombuffer(rows.tobytes(), dtype=np.uint8)
        return message

    assert imported(TestBag.recorded(seconds=0.5).changed(CLOUD, longer).write(tmp_path), tmp_path) == 0
    drive = drive_in(tmp_path)
    assert drive.lidars["top"].revolution_s == pytest.approx(0.108, abs=1e-3) and len(drive.sweeps) == 5


def test_a_drive_written_as_mcap_is_read_back(tiny_scene, tmp_path):
    """Two sweeps get times from 0 on, a lens and 10 Hz: all of the folder that messages hold is equal."""
    source = tmp_path / "source"
    write_drive(tiny_scene, source)
    record = json.loads((source / "drive.json").read_text())
    (name,) = record["cameras"]
    record["cameras"][name]["distortion"] = {"model": "fisheye", "coefficients": [0.01, -0.002, 0.0, 0.001]}
    record |= {"tracks": [], "key_frames": None, "origin": None}
    for frame in record["frames"]:
        frame["key_frame"] = None
    for sweep in record["sweeps"]:
        with np.load(source / sweep["file"]) as arrays:
            points = np.stack([arrays[axis] for axis in "xyz"], axis=1)
            intensity, ring = arrays["intensity"], arrays["ring"]
        times = np.linspace(0.0, 0.09, len(points))
        write_sweep(source / sweep["file"], LidarReturns(points, intensity, ring, times))
    (source / "drive.json").write_text(json.dumps(record))
    write_mcap(source, tmp_path / "drive.mcap")
    assert imported(tmp_path / "drive.mcap", tmp_path) == 0
    was, now = read_drive(source), drive_in(tmp_path)
    assert now.cameras.keys() == was.cameras.keys() and now.lidars.keys() == was.lidars.keys()
    assert (now.cameras[name].K, now.cameras[name].distortion) == (was.cameras[name].K, was.cameras[name].distortion)
    before, after = whole_scene(was, source), scene_in(tmp_path)
    assert len(after.frames) == len(before.frames) and len(after.sweeps) == len(before.sweeps)
    shift = after.frames[0].ego_to_world[:3, 3] - before.frames[0].ego_to_world[:3, 3]
    for one, other in zip(after.frames, before.frames, strict=True):
        assert one.timestamp == other.timestamp and one.camera == other.camera
        for pose, expected in (
            (one.camera_to_world, other.camera_to_world),
            (one.ego_to_world, other.ego_to_world),
        ):
            np.testing.assert_allclose(pose, rigid(expected[:3, :3], expected[:3, 3] + shift), atol=1e-6)
        assert Path(one.image_path).read_bytes() == Path(other.image_path).read_bytes()
    for one, other in zip(after.sweeps, before.sweeps, strict=True):
        assert (one.timestamp, one.lidar) == (other.timestamp, other.lidar)
        returns, expected = read_returns(one), read_returns(other)
        points = apply(one.sensor_to_world, returns.points) - shift
        np.testing.assert_allclose(points, apply(other.sensor_to_world, expected.points), atol=1e-4)
        np.testing.assert_array_equal(returns.intensity, expected.intensity)
        np.testing.assert_array_equal(returns.rings, expected.rings)
        np.testing.assert_allclose(returns.offsets_s, expected.offsets_s, atol=1e-7)


def test_a_window_is_imported_alone(tmp_path):
    path = TestBag.recorded(seconds=2.0).write(tmp_path)
    assert imported(path, tmp_path, "--start", "0.55", "--end", "1.2") == 0
    begin = START - 200_000 + 550_000
    stamps = [frame.timestamp for frame in drive_in(tmp_path).frames]
    assert stamps == [s for s in range(START, START + 2_000_000, 100_000) if begin <= s + 5_000 < begin + 650_000]
    record = json.loads((tmp_path / "out/import.json").read_text())
    assert record["window_s"] == [0.55, 1.2] and record["sensors"]["front"]["written"] == len(stamps)


def test_decisions_and_their_reasons_are_in_the_folder(tmp_path):
    path = TestBag.recorded().write(tmp_path)
    assert (
        imported(path, tmp_path, edit=lambda text: text.replace("stamp: middle", "stamp: end  # seen on a LED #")) == 0
    )
    decisions = json.loads((tmp_path / "out/import.json").read_text())["decisions"]
    found = {one["key"]: (one["value"], one["reason"]) for one in decisions}
    assert found["cameras.front.stamp"][0] == "end" and found["cameras.front.stamp"][1].startswith("seen on a LED #")
    values = yaml.safe_load((tmp_path / "topics.yaml").read_text())
    assert {"clock", "world", "vehicle", "poses", "key_frames.sensor"} <= found.keys() | {"key_frames.sensor"}
    assert all(reason for key, (_, reason) in found.items()), "every line of the proposal has its reason"
    assert {f"lidars.top.{key}" for key in values["lidars"]["top"]} <= found.keys()


def test_map_says_when_images_and_points_were_measured(tmp_path):
    """An exposure of 20 ms stamped at its start, and sweeps stamped at their end whose times count from their start."""

    def edit(text: str) -> str:
        text = text.replace("stamp: middle", "stamp: start").replace("exposure_s: 0.0", "exposure_s: 0.02")
        text = text.replace("stamp: start  # as drivers", "stamp: end  # as drivers")
        return text.replace("counts_from: stamp", "counts_from: start")

    assert imported(TestBag.recorded().write(tmp_path), tmp_path, edit=edit) == 0
    drive = drive_in(tmp_path)
    assert [frame.timestamp for frame in drive.frames[:2]] == [START + 10_000, START + 110_000]
    with np.load(tmp_path / "out" / drive.sweeps[0].file) as arrays:
        assert arrays["time"].min() == pytest.approx(-0.1) and arrays["time"].max() == pytest.approx(-0.001, abs=1e-6)


def test_vehicle_frame_may_be_above_the_rear_axle(tmp_path):
    """The frame of the vehicle is 0.3 m above the ground, turned by 180 degrees, 1 m ahead of the axle."""

    def edit(text: str) -> str:
        return text.replace(
            "translation: [0, 0, 0], rotation: [1, 0, 0, 0]", "translation: [1, 0, 0.3], rotation: [0, 0, 0, 1]"
        )

    assert imported(TestBag.recorded().write(tmp_path), tmp_path, edit=edit) == 0
    drive = drive_in(tmp_path)
    to_ego = rigid(Rotation.from_euler("z", np.pi).as_matrix(), np.array([1, 0, 0.3]))
    np.testing.assert_allclose(matrix_of(drive.lidars["top"].sensor_to_ego), to_ego @ LIDAR, atol=1e-9)
    pose = next(pose for pose in drive.ego_poses if pose.timestamp == START + 50_000)
    np.testing.assert_allclose(matrix_of(pose), ego(START + 50_000) @ np.linalg.inv(to_ego), atol=1e-9)


def test_odometry_gives_poses_without_tf_of_the_vehicle(tmp_path):
    bag = TestBag.recorded().without("/tf")
    for stamp in range(START - 100_000, START + 1_200_000, 25_000):
        bag.messages.append(("/odometry", stamp, bag.make.odometry(stamp, ego(stamp))))
    assert imported(bag.write(tmp_path), tmp_path) == 0
    text = (tmp_path / "topics.yaml").read_text()
    assert "poses: /odometry" in text and "world: odom" in text
    for frame in scene_in(tmp_path).frames:
        np.testing.assert_allclose(frame.ego_to_world[:3, :3], ego(frame.timestamp)[:3, :3], atol=1e-6)


def test_a_camera_that_tf_moves_has_poses_of_its_own(tmp_path):
    """A head on /tf, and a frame with x forward."""
    bag = TestBag.recorded().without("/tf_static")
    lidar = bag.make.transforms(START, ("base_link", "top", LIDAR))
    bag.messages.append(("/tf_static", START - 150_000, lidar))

    def head(stamp: int) -> np.ndarray:
        return rigid(Rotation.from_euler("z", (stamp - START) * 1e-6).as_matrix(), np.array([1.5, 0.0, 1.4]))

    for stamp in range(START - 100_000, START + 1_200_000, 10_000):
        bag.messages.append(("/tf", stamp, bag.make.transforms(stamp, ("base_link", "front_optical", head(stamp)))))
    edit = lambda text: text.replace("axes: optical", "axes: forward")  # noqa: E731
    assert imported(bag.write(tmp_path), tmp_path, edit=edit) == 0
    scene = scene_in(tmp_path)
    axes = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    for frame in scene.frames:
        expected = ego(frame.timestamp) @ head(frame.timestamp) @ rigid(axes, np.zeros(3))
        np.testing.assert_allclose(frame.camera_to_world[:3, :3], expected[:3, :3], atol=1e-6)
        np.testing.assert_allclose(frame.camera_to_world[:3, 3] + scene.origin, expected[:3, 3], atol=2e-4)


def test_images_without_poses_are_left_out_and_counted(tmp_path, capsys):
    """Poses end 0.15 s before the last image, which is beyond the 0.1 s of continued motion, and lack 1.2 s."""
    bag = TestBag.recorded(seconds=3.0)
    last = START + 2_900_000

    def is_there(topic: str, log: int) -> bool:
        stamp = log - 5_000
        return topic != "/tf" or (stamp <= last - 150_000 and not START + 510_000 < stamp < START + 1_760_000)

    bag.messages = [one for one in bag.messages if is_there(one[0], one[1])]
    assert imported(bag.write(tmp_path), tmp_path) == 0
    said = capsys.readouterr().out
    assert "13 of 30 images of front, 13 of 30 sweeps of top" in said and "more than 1 s apart" in said
    stamps = [frame.timestamp - START for frame in drive_in(tmp_path).frames]
    missing = {*range(600_000, 1_800_000, 100_000), 2_900_000}
    assert stamps == [s for s in range(0, 3_000_000, 100_000) if s not in missing]
    final = drive_in(tmp_path).ego_poses[-1]
    assert final.timestamp == last - 100_000
    np.testing.assert_allclose(matrix_of(final)[:3, 3], ego(final.timestamp)[:3, 3], atol=0.02)


def test_memory_does_not_grow_with_the_bag(tmp_path):
    """30 raw images of 0.9 MB."""
    make, rows = Messages(), np.random.default_rng(0).integers(0, 256, (480, 1920), dtype=np.uint8)
    bag = TestBag.recorded(seconds=2.0).without(IMAGE, INFO, CLOUD)
    changes = {"width": 640, "height": 480, "k": [500, 0, 320, 0, 500, 240, 0, 0, 1], "d": []}
    bag.messages.append(("/cam/camera_info", START, make.info(START, "front_optical", **changes)))
    for i in range(30):
        stamp = START + 60_000 * i
        bag.messages.append(("/cam/image_raw", stamp, make.raw(stamp, "front_optical", "rgb8", (640, 480), rows)))
    path = bag.write(tmp_path)
    topics = tmp_path / "topics.yaml"
    assert main(["import", "bag", str(path), "--propose", str(topics)]) == 0
    topics.write_text(topics.read_text().replace("raw_images: png", "raw_images: jpeg"))
    tracemalloc.start()
    assert main(["import", "bag", str(path), "--map", str(topics), "--out", str(tmp_path / "out")]) == 0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size > 25e6 and peak < 20e6, peak
    assert len(drive_in(tmp_path).frames) == 30


def test_names_of_sensors_are_those_of_their_namespaces(tmp_path):
    """Numbers and words that YAML takes for something else get a prefix."""
    bag = TestBag.recorded(seconds=0.3)
    bag.messages = [m for m in bag.messages if m[0] not in (IMAGE, INFO)]
    names = {
        "/sensing/camera/0": "sensor_0",
        "/cam_left/color": "cam_left",
        "/on": "sensor_on",
        "/b/cam_left": "cam_left_2",
    }
    for stamp in range(START, START + 300_000, 100_000):
        for space in names:
            bag.messages.append((f"{space}/image_raw", stamp, bag.make.compressed(stamp, "front_optical", jpeg(0))))
            bag.messages.append((f"{space}/camera_info", stamp, bag.make.info(stamp, "front_optical")))
    assert imported(bag.write(tmp_path), tmp_path) == 0
    values = yaml.safe_load((tmp_path / "topics.yaml").read_text())["cameras"]
    found = {camera["images"].removesuffix("/image_raw"): name for name, camera in values.items()}
    assert found.keys() == names.keys()
    assert sorted(found.values()) == sorted(names.values())
    assert all(camera["info"] == camera["images"].replace("image_raw", "camera_info") for camera in values.values())


def test_missing_extra_is_a_sentence(tmp_path, monkeypatch, capsys):
    path = TestBag.recorded(seconds=0.2).write(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    assert imported(path, tmp_path) == 1
    assert capsys.readouterr().err == "drivesplat: ROS bags need the package rosbags: pip install 'drivesplat[ros]'\n"
