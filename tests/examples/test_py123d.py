"""The converter of py123d: a log as py123d 0.7 gives it, compared with the world that it shows.

py123d itself cannot be installed beside drivesplat. `Log` has the part of its interface that the converter uses, with
the frames that its readers of datasets use: points in the IMU's frame, poses of cameras and boxes in the world.
"""

import json
import sys
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drives import CAMERA, START_US, World, rays_at, turning_world
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import apply, inverse, rigid
from examples import py123d_drive

TIMES = [START_US + 100_000 * i for i in range(5)]
AXLE = 0.4
IMU = rigid(Rotation.from_euler("z", 0.1).as_matrix(), np.array([0.3, 0.0, AXLE + 0.2]))
"""The IMU in the ego frame, which is on the ground."""
LIDAR = rigid(Rotation.from_euler("z", -0.3).as_matrix(), np.array([0.9, 0.0, 1.8]))
LENS = SimpleNamespace(k1=-0.05, k2=0.01, p1=0.001, p2=-0.002, k3=0.0)
Identity = Enum("Identity", ["PCAM_F0", "FMCAM_L", "FTCAM_F0", "LIDAR_TOP"])
Model = Enum("Model", ["PINHOLE", "FISHEYE_MEI", "FTHETA"])
Label = Enum("Label", ["REGULAR_VEHICLE", "LARGE_VEHICLE", "BOLLARD"])
LABELS = {"car": Label.REGULAR_VEHICLE, "truck": Label.LARGE_VEHICLE, "pedestrian": Label.BOLLARD}


def pose(matrix: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(transformation_matrix=matrix)


def at(time: int) -> SimpleNamespace:
    return SimpleNamespace(time_us=time)


class Log:
    """A log of a world; sweeps of its LiDAR are stored with those of all, as most datasets' are."""

    number_of_iterations = len(TIMES)

    def __init__(self, world: World):
        self.world = world
        camera = {"width": world.width, "height": world.height, "camera_to_imu_se3": pose(inverse(IMU) @ CAMERA)}
        k = world.intrinsics
        pinhole = SimpleNamespace(fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2])
        mei = SimpleNamespace(gamma1=k[0, 0], gamma2=k[1, 1], u0=k[0, 2], v0=k[1, 2])
        self.cameras = {
            Identity.PCAM_F0: SimpleNamespace(
                camera_model=Model.PINHOLE, intrinsics=pinhole, distortion=LENS, is_undistorted=True, **camera
            ),
            Identity.FMCAM_L: SimpleNamespace(
                camera_model=Model.FISHEYE_MEI, projection=mei, mirror_parameter=0.9, distortion=LENS, **camera
            ),
            Identity.FTCAM_F0: SimpleNamespace(camera_model=Model.FTHETA, **camera),
        }

    def get_log_metadata(self) -> Any:
        return SimpleNamespace(dataset="av2-sensor", log_name="log1")

    def get_ego_state_se3_metadata(self) -> Any:
        axle = rigid(np.eye(3), np.array([0.0, 0.0, AXLE]))
        return SimpleNamespace(rear_axle_to_imu_se3=pose(inverse(IMU) @ axle))

    def get_all_ego_state_se3_timestamps(self) -> list[Any]:
        return [at(time) for time in TIMES]

    def get_ego_state_se3_at_timestamp(self, time: Any) -> Any:
        return SimpleNamespace(imu_se3=pose(self.world.ego(time.time_us) @ IMU))

    def get_camera_metadatas(self) -> dict[Any, Any]:
        return self.cameras

    def get_all_camera_timestamps(self, camera: Any) -> list[Any]:
        return [at(time + 10_000) for time in TIMES[:-1]]

    def get_camera_at_timestamp(self, time: Any, camera: Any) -> Any:
        image = self.world.image((time.time_us - START_US) * 1e-6)
        return SimpleNamespace(image=image, camera_to_global_se3=pose(self.world.ego(time.time_us) @ CAMERA))

    def get_lidar_metadatas(self) -> dict[Any, Any]:
        return {Identity.LIDAR_TOP: SimpleNamespace(lidar_to_imu_se3=pose(inverse(IMU) @ LIDAR))}

    def get_all_lidar_timestamps(self, lidar: Any) -> list[Any]:
        return [at(time) for time in (*TIMES, TIMES[-1] + 100_000)] if lidar == "lidar_merged" else []

    def hits(self, time: int) -> np.ndarray:
        azimuth, elevation = np.meshgrid(np.arange(0, 2 * np.pi, 0.05), np.radians([-12.0, -8.0, -3.0]))
        return self.world.hits(LIDAR, rays_at(azimuth.ravel(), elevation.ravel()), time)

    def get_lidar_at_timestamp(self, time: Any, lidar: Any) -> Any:
        points = apply(inverse(self.world.ego(time.time_us) @ IMU), self.hits(time.time_us)).astype(np.float32)
        count = len(points)
        return SimpleNamespace(
            xyz=points, intensity=np.full(count, 51, np.uint8), channel=(np.arange(count) % 3).astype(np.uint8),
            timestamps=time.time_us + np.arange(count),
        )  # fmt: skip

    def get_all_box_detections_se3_timestamps(self) -> list[Any]:
        return [at(time) for time in TIMES]

    def get_box_detections_se3_at_timestamp(self, time: Any) -> list[Any]:
        return [
            SimpleNamespace(
                attributes=SimpleNamespace(label=LABELS[thing.category], track_token=thing.category),
                bounding_box_se3=SimpleNamespace(
                    center_se3=pose(self.world.box(thing, time.time_us)),
                    **dict(zip(("length", "width", "height"), thing.size, strict=True)),
                ),
            )
            for thing in self.world.things
        ]


@pytest.fixture(autouse=True)
def log(monkeypatch) -> Log:
    """A log called log1 in py123d's data."""
    found = Log(turning_world(rigid(Rotation.from_euler("z", 0.7).as_matrix(), np.array([250.0, 420.0, 12.0]))))
    api = ModuleType("py123d.api")
    api.SceneFilter = lambda log_names: log_names
    api.get_filtered_scenes = lambda names, data_root: [found] if names == ["log1"] else []
    monkeypatch.setitem(sys.modules, "py123d", ModuleType("py123d"))
    monkeypatch.setitem(sys.modules, "py123d.api", api)
    return found


def converted(out: Path, *options: str) -> int:
    return py123d_drive.main(["data", "log1", str(out), "--axle-height", str(AXLE), *options])


def test_a_log_shows_its_world(log, tmp_path, capsys):
    out = tmp_path / "drive"
    assert converted(out) == 0
    assert "camera ftcam_f0 has no pinhole or MEI calibration" in capsys.readouterr().err
    assert check(out, None) == []
    scene, world = whole_scene(read_drive(out), out), log.world
    assert scene.licence.startswith("Argoverse 2") and [camera.name for camera in scene.cameras] == [
        "fmcam_l", "pcam_f0",
    ]  # fmt: skip
    for frame in scene.frames:
        for mine, truth in (
            (frame.ego_to_world, world.ego(frame.timestamp)),
            (frame.camera_to_world, world.ego(frame.timestamp) @ CAMERA),
        ):
            np.testing.assert_allclose(mine[:3, 3] + scene.origin, truth[:3, 3], atol=2e-3)
            np.testing.assert_allclose(mine[:3, :3], truth[:3, :3], atol=1e-4)
        np.testing.assert_array_equal(Image.open(frame.image_path), world.image((frame.timestamp - START_US) * 1e-6))
    assert [sweep.timestamp for sweep in scene.sweeps] == TIMES, "the last one has no pose"
    for sweep in scene.sweeps:
        returns = read_returns(sweep)
        points = apply(sweep.sensor_to_world, returns.points) + scene.origin
        np.testing.assert_allclose(points, log.hits(sweep.timestamp), atol=1e-5)
        assert set(returns.rings) == {0, 1, 2} and returns.intensity[0] == pytest.approx(0.2)
        np.testing.assert_allclose(returns.offsets_s, 1e-6 * np.arange(len(points)), atol=1e-9)
    classes = {track.id: track.object_class for track in scene.tracks}
    assert classes == {
        "car": ObjectClass.CAR, "truck": ObjectClass.TRUCK, "pedestrian": ObjectClass.OTHER_MOVABLE,
    }  # fmt: skip
    for track in scene.tracks:
        thing = next(thing for thing in world.things if thing.category == track.id)
        np.testing.assert_allclose(track.size, thing.size)
        for time, box in zip(track.timestamps.tolist(), track.object_to_world, strict=True):
            truth = world.box(thing, time)
            np.testing.assert_allclose(box[:3, 3] + scene.origin, truth[:3, 3], atol=1e-9)
            np.testing.assert_allclose(box[:3, :3], truth[:3, :3], atol=1e-9)


def test_lenses_are_stated_unless_images_are_undistorted(log, tmp_path):
    log.cameras[Identity.PCAM_F0].is_undistorted = False
    assert converted(tmp_path / "drive", "--uncompensated") == 0
    record = json.loads((tmp_path / "drive/drive.json").read_text())
    lenses = {name: camera["distortion"] for name, camera in record["cameras"].items()}
    assert lenses["pcam_f0"] == {"model": "opencv", "coefficients": [-0.05, 0.01, 0.001, -0.002, 0.0]}
    assert lenses["fmcam_l"] == {"model": "mei", "coefficients": [0.9, -0.05, 0.01, 0.001, -0.002]}
    assert record["lidars"]["lidar_top"]["motion_compensated"] is False


def test_returns_without_times_cannot_be_moved(log, tmp_path, monkeypatch, capsys):
    timed = log.get_lidar_at_timestamp
    monkeypatch.setattr(
        log, "get_lidar_at_timestamp", lambda *at: SimpleNamespace(**{**vars(timed(*at)), "timestamps": None})
    )
    assert converted(tmp_path / "as_they_are") == 0 and check(tmp_path / "as_they_are", None) == []
    assert converted(tmp_path / "moved", "--uncompensated") == 1
    assert "returns of lidar_top have no times" in capsys.readouterr().err


def test_what_is_not_there_is_one_sentence(tmp_path, monkeypatch, capsys):
    (tmp_path / "taken").write_text("")
    assert converted(tmp_path) == 1 and "is not empty" in capsys.readouterr().err
    assert converted(tmp_path / "out", "--cameras", "rear") == 1
    assert "there are: fmcam_l, ftcam_f0, pcam_f0" in capsys.readouterr().err
    assert py123d_drive.main(["data", "log7", str(tmp_path / "other")]) == 1
    assert "there is no log log7" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "py123d.api", None)
    assert converted(tmp_path / "third") == 1
    assert capsys.readouterr().err.startswith("py123d_drive: py123d cannot be imported")
