"""scene.alpasim.usdz, read by a reader of its own: what AlpaSim requires of each file, by the documentation of its
format alone."""

import io
import json
import math
import re
import shutil
import struct
import uuid
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.shared_runs import CAR, made_once
from helpers.workflow_copy import WorkflowCopy
from plyfile import PlyData

import drivesplat
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.export.alpasim import export_alpasim, scene_id
from drivesplat.settings.export import AlpasimJob
from drivesplat.settings.simulate import VehicleBody

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("alpasim")]
TARGET = "results/0001/street/scene.alpasim.usdz"
BODY = VehicleBody(length=5.0, rear_overhang=1.1)
CAMERA, TIME = "CAM_FRONT", 1.0
LABELS = {
    "automobile", "heavy_truck", "bus", "train_or_tram_car", "trailer", "other_vehicle", "person", "rider", "stroller",
    "animal", "protruding_object",
}  # fmt: skip


@pytest.fixture(scope="module")
def copy(finished_run, tmp_path_factory) -> WorkflowCopy:
    """A workflow with the scene of one method, made once for all workers."""

    def run(folder: Path) -> None:
        made = finished_run.again(folder / "workflow")
        made.config["export"] = {"vehicle": BODY.model_dump()}
        made.write_config()
        done = made.run(TARGET)
        assert done.returncode == 0, done.stdout

    folder = made_once(tmp_path_factory, "alpasim", run) / "workflow"
    return WorkflowCopy(folder, yaml.safe_load((folder / "mine.yaml").read_text()))


@pytest.fixture(scope="module")
def usdz(copy) -> Path:
    return copy.folder / TARGET


@pytest.fixture(scope="module")
def scene(usdz) -> "ReadScene":
    return ReadScene.of(usdz)


@pytest.fixture(scope="module")
def drive(copy) -> TrainedDrive:
    return drivesplat.open(copy.folder / "results/0001/street", device="cpu")


# ---- the reader


@dataclass
class ReadScene:
    metadata: dict[str, Any]
    rig: dict[str, Any]
    tracks: dict[str, Any]
    info: dict[str, Any]
    ground: np.ndarray
    mesh: np.ndarray

    @classmethod
    def of(cls, path: Path) -> "ReadScene":
        with zipfile.ZipFile(path) as archive:
            assert archive.testzip() is None
            records = [json.loads(archive.read(f"{name}.json")) for name in ("rig_trajectories", "sequence_tracks")]
            meshes = [triangles(archive.read(name)) for name in ("mesh_ground.ply", "mesh.ply")]
            info = json.loads(archive.read("data_info.json"))
            return cls(yaml.safe_load(archive.read("metadata.yaml")), *records, info, *meshes)

    @property
    def trajectory(self) -> dict[str, Any]:
        (only,) = self.rig["rig_trajectories"]
        return only

    @property
    def poses(self) -> np.ndarray:
        return np.array(self.trajectory["T_rig_worlds"])

    @property
    def times(self) -> np.ndarray:
        return np.array(self.trajectory["T_rig_world_timestamps_us"])


def triangles(content: bytes) -> np.ndarray:
    """The corners (t, 3, 3) of the triangles of a PLY file."""
    data = PlyData.read(io.BytesIO(content))
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)
    faces = np.stack(list(data["face"]["vertex_indices"]))
    assert faces.shape[1] == 3 and faces.min() >= 0 and faces.max() < len(vertices) and np.isfinite(vertices).all()
    return vertices[faces]


def require_rigid(poses: np.ndarray) -> None:
    assert poses.shape[-2:] == (4, 4) and np.isfinite(poses).all()
    rotations = poses[..., :3, :3]
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, -1, -2), np.zeros_like(rotations) + np.eye(3), atol=1e-5
    )
    assert (np.linalg.det(rotations) > 0.9).all()
    assert (poses[..., 3, :] == [0.0, 0.0, 0.0, 1.0]).all()


def hit(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray] | None:
    """The distance along a ray to the nearest triangle and its unit normal (Möller and Trumbore 1997)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    determinant = (first * across).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((origin - corners[:, 0]) * across).sum(axis=1) / determinant
        over = np.cross(origin - corners[:, 0], first)
        v = over @ direction / determinant
        distance = (second * over).sum(axis=1) / determinant
    found = np.flatnonzero((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (distance >= 0.0))
    if not len(found):
        return None
    nearest = found[distance[found].argmin()]
    normal = np.cross(first[nearest], second[nearest])
    return float(distance[nearest]), normal / np.linalg.norm(normal)


def integers(values: list) -> bool:
    return all(type(value) is int for value in values)


# ---- what it finds


def test_members_are_stored_aligned_and_dated_alike(usdz):
    """OpenUSD's rule for packages: no compression, data at multiples of 64 bytes."""
    with zipfile.ZipFile(usdz) as archive, open(usdz, "rb") as file:
        names = archive.namelist()
        assert len(names) == len(set(names))
        assert {"metadata.yaml", "rig_trajectories.json", "sequence_tracks.json", "data_info.json"} < set(names)
        for member in archive.infolist():
            file.seek(member.header_offset + 26)
            name, extra = struct.unpack("<HH", file.read(4))
            assert (member.header_offset + 30 + name + extra) % 64 == 0, member.filename
            assert member.compress_type == zipfile.ZIP_STORED and member.date_time == (1980, 1, 1, 0, 0, 0)


def test_metadata_has_the_fields_that_the_runtime_reads(scene, drive):
    found = scene.metadata
    texts = ("scene_id", "version_string", "training_date", "dataset_hash", "uuid")
    assert all(isinstance(found[name], str) and found[name] for name in texts)
    assert found["is_resumable"] is False and found["training_step_outputs"] == {}
    assert re.fullmatch(r"clipgt-[\w-]+", found["scene_id"])
    assert str(uuid.UUID(found["uuid"])) == found["uuid"] == found["scene_id"].removeprefix("clipgt-")
    assert found["sensors"] == {"camera_ids": ["CAM_FRONT"], "lidar_ids": ["LIDAR_TOP"]}
    assert {"name", "run_id", "run_url"} == set(found["logger"]) and "0001" in found["logger"]["name"]
    times = found["time_range"]
    assert (
        integers([times["start"], times["end"]]) and times["start"] == scene.times[0] < times["end"] == scene.times[-1]
    )
    assert scene.info["sequence_id"] == found["scene_id"] == scene_id(drive)
    assert scene.info["pose-range"]["start-timestamp_us"] == scene.times[0]


def test_the_rig_moves_over_the_recording_and_covers_its_images(scene, copy):
    rig, record = scene.trajectory, copy.read("results/0001/scene.json")
    assert np.array(scene.rig["world_to_nre"]["matrix"]).tolist() == np.eye(4).tolist() == scene.rig["T_world_base"]
    assert integers(rig["T_rig_world_timestamps_us"]) and (np.diff(scene.times) > 0).all()
    require_rigid(scene.poses)
    assert np.abs(scene.poses[:, :3, 3] - scene.poses[:, :3, 3].astype(np.float32)).max() < 1e-4
    assert np.diff(scene.times).max() <= 40_000
    (key,) = rig["cameras_frame_timestamps_us"]
    assert key == f"CAM_FRONT@{rig['sequence_id']}" and key in scene.rig["camera_calibrations"]
    images = rig["cameras_frame_timestamps_us"][key]
    frames = sorted((frame for frame in record["frames"]), key=lambda frame: frame["timestamp"])
    assert len(images) == len(frames) and images == sorted(images)
    for (start, end), frame in zip(images, frames, strict=True):
        assert integers([start, end]) and start < end and scene.times[0] <= start and end <= scene.times[-1]
        assert abs((start + end) / 2 - frame["timestamp"]) <= 1.0
        pose = scene.poses[np.searchsorted(scene.times, frame["timestamp"])]
        np.testing.assert_allclose(pose, frame["ego_to_world"], atol=1e-6)


def test_the_box_of_the_rig_is_that_of_the_settings(scene):
    box = scene.trajectory["rig_bbox"]
    assert box["dim"] == [5.0, 1.9, 1.6] and box["rot"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(box["centroid"], [1.4, 0.0, 0.8])  # 1.1 m behind the axle to 3.9 m before it


def test_cameras_are_those_of_the_scene(scene, copy, drive):
    """A pixel of the recorded image, by the scene's record, is where the calibration says it is."""
    record = copy.read("results/0001/scene.json")
    frame = next(frame for frame in record["frames"] if frame["camera"] == "CAM_FRONT")
    ((key, camera),) = scene.rig["camera_calibrations"].items()
    assert key.partition("@")[0] == camera["logical_sensor_name"] == "CAM_FRONT"
    require_rigid(np.array(camera["T_sensor_rig"]))
    mount = np.linalg.inv(frame["ego_to_world"]) @ np.array(frame["camera_to_world"])
    np.testing.assert_allclose(camera["T_sensor_rig"], mount, atol=1e-9)
    assert np.array(camera["T_sensor_rig"])[0, 2] > 0.9  # the optical axis is ahead
    model = camera["camera_model"]
    assert model["type"] == "opencv-pinhole"
    found = model["parameters"]
    assert [len(found[name]) for name in ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")] == [6, 2, 4]
    assert not any(found["radial_coeffs"] + found["tangential_coeffs"] + found["thin_prism_coeffs"])
    width, height = found["resolution"]
    assert (width, height) == drive.render(CAMERA, 0.0).image.shape[1::-1]
    assert found["shutter_type"] in ("GLOBAL", "ROLLING_TOP_TO_BOTTOM")
    scale = width / frame["width"]
    (fx, _, cx), (_, fy, cy), _ = frame["intrinsics"]  # of pixel centres
    np.testing.assert_allclose(found["focal_length"], [fx * scale, fy * scale], rtol=1e-6)
    np.testing.assert_allclose(found["principal_point"], [(cx + 0.5) * scale, (cy + 0.5) * scale], rtol=1e-6)


def test_tracks_are_within_the_recording_and_flagged_where_they_can_be_moved(scene, drive, copy):
    assert list(scene.tracks) == ["dummy_chunk_id"]
    data, dims = scene.tracks["dummy_chunk_id"]["tracks_data"], scene.tracks["dummy_chunk_id"]["cuboidtracks_data"]
    assert set(dims) == {"cuboids_dims"}
    columns = [data[f"tracks_{name}"] for name in ("id", "label_class", "flags", "timestamps_us", "poses")]
    assert len({len(column) for column in (*columns, dims["cuboids_dims"])}) == 1
    assert len(set(data["tracks_id"])) == len(data["tracks_id"]) > 1
    for _, label, flags, times, poses, size in zip(*columns, dims["cuboids_dims"], strict=True):
        assert label in LABELS and isinstance(flags, list) and len(size) == 3 and min(size) > 0.0
        assert integers(times) and len(times) == len(poses) >= 2 and (np.diff(times) > 0).all()
        assert scene.times[0] <= times[0] and times[-1] <= scene.times[-1]
        values = np.array(poses)
        assert values.shape == (len(times), 7) and np.isfinite(values).all()
        np.testing.assert_allclose(np.linalg.norm(values[:, 3:], axis=1), 1.0, atol=1e-6)
        assert ((values[1:, 3:] * values[:-1, 3:]).sum(axis=1) > 0.0).all()
    flagged = {
        own for own, flags in zip(data["tracks_id"], data["tracks_flags"], strict=True) if "CONTROLLABLE" in flags
    }
    assert flagged == set(drive.actors.index[drive.actors["editable"]]) == {CAR}
    known = {track["id"]: track for track in copy.read("results/0001/scene.json")["tracks"]}
    assert set(data["tracks_id"]) <= set(known)


def test_a_track_is_where_the_drive_has_the_object(scene, drive):
    data = scene.tracks["dummy_chunk_id"]["tracks_data"]
    number = data["tracks_id"].index(CAR)
    first = min(frame.timestamp for frame in drive.scene.frames)
    for at in (0, len(data["tracks_poses"][number]) // 2):
        time, (x, y, z, qx, qy, qz, qw) = data["tracks_timestamps_us"][number][at], data["tracks_poses"][number][at]
        seconds = (time - first) * 1e-6
        if seconds < 0.0:
            continue
        pose = drive.state(seconds).actors[CAR].pose
        np.testing.assert_allclose([x, y, z], pose[:3, 3], atol=1e-5)
        ahead = [1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy + qz * qw), 2.0 * (qx * qz - qy * qw)]
        np.testing.assert_allclose(ahead, pose[:3, 0], atol=1e-5)
    moved = np.linalg.norm(np.subtract(*np.array(data["tracks_poses"][number])[[0, -1], :3]))
    assert moved > 3.0  # it drives


def test_the_vehicle_stands_on_the_ground_all_along_its_path(scene):
    """As AlpaSim's physics: rays of 100 m downwards, from about the vehicle."""
    box = scene.trajectory["rig_bbox"]
    x, y, _ = box["centroid"]
    length, width, _ = box["dim"]
    beneath = [(0.0, 0.0), *((x + i * length / 2, y + j * width / 2) for i in (-1, 1) for j in (-1, 1))]
    ends = [scene.poses[i] @ shift for i, shift in ((0, moved(-8.0)), (-1, moved(8.0)))]
    for pose in (*scene.poses[:: max(1, len(scene.poses) // 20)], *ends):
        up = pose[:3, 2]
        for forward, left in beneath:
            place = pose[:3, 3] + forward * pose[:3, 0] + left * pose[:3, 1]
            found = hit(scene.ground, place + 50.0 * up, -up)
            assert found is not None, "a hole in the ground"
            assert abs(found[0] - 50.0) < 0.1
            assert math.degrees(math.acos(min(1.0, found[1] @ up))) < 10.0


def moved(forward: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = forward
    return pose


def test_the_coarse_mesh_has_the_ground_and_what_stands_there(scene, drive):
    corners = scene.mesh
    assert 100 < len(corners) < 2_000_000
    assert (np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0.0).all()
    for pose in scene.poses[:: max(1, len(scene.poses) // 5)]:
        found = hit(corners, pose[:3, 3] + 1.0 * pose[:3, 2], -pose[:3, 2])
        assert found is not None and abs(found[0] - 1.0) < 0.4 and found[1] @ pose[:3, 2] > 0.7


# ---- the drive in it, and the workflow


def test_the_drive_in_it_renders_the_same_bytes_where_there_is_nothing_else(usdz, drive, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    alone = Path(shutil.copy(usdz, tmp_path / "elsewhere.usdz"))
    opened = drivesplat.open(alone, device="cpu")
    assert opened.folder.is_relative_to(tmp_path) and opened.folder.name == "street"
    wanted, found = (own.render(CAMERA, TIME, outputs=["rgb", "depth"]).arrays() for own in (drive, opened))
    assert all(found[name].tobytes() == wanted[name].tobytes() for name in wanted)
    moved_car = (
        own.edited([{"shift": {"track": CAR, "lateral": 1.0}}]).render(CAMERA, TIME) for own in (drive, opened)
    )
    first, second = (view.image.tobytes() for view in moved_car)
    assert first == second
    assert scene_id(opened) == scene_id(drive) and opened.where == drive.where
    assert list(opened.actors.index) == list(drive.actors.index)
    again = drivesplat.open(str(alone), device="cpu")
    assert again.folder == opened.folder


def test_another_process_writes_the_same_bytes(usdz, drive, tmp_path):
    """But for the digest of the code, which only the workflow knows."""
    file = tmp_path / "again.usdz"
    export_alpasim(file, drive, AlpasimJob(body=BODY), drive.provenance)
    with zipfile.ZipFile(usdz) as made, zipfile.ZipFile(file) as again:
        assert made.namelist() == again.namelist()
        differing = [name for name in made.namelist() if made.read(name) != again.read(name)]
        assert set(differing) <= {"metadata.yaml"}
        records = [yaml.safe_load(archive.read("metadata.yaml")) for archive in (made, again)]
    assert {key for key in records[0] if records[0][key] != records[1][key]} <= {"version_string", "dataset_hash"}


def test_the_target_makes_a_scene_of_each_method_and_again_only_after_a_change(copy, tmp_path):
    copy = copy.again(tmp_path / "workflow")
    assert copy.planned("alpasim") == {"export_alpasim": 1, "alpasim": 1}  # vanilla
    with copy.set_to(export={"vehicle": {"length": 4.0}, "formats": ["alpasim"]}):
        assert copy.planned("exports") == {"export_alpasim": 2, "exports": 1}


def test_drives_that_are_no_recording_are_refused(drive, tmp_path):
    edited = drive.edited([{"remove": {"track": CAR}}])
    with pytest.raises(RequestError, match="as recorded"):
        export_alpasim(tmp_path / "a.usdz", edited, AlpasimJob(), drive.provenance)
    folder = Path(shutil.copytree(drive.folder.parent, tmp_path / "0001")) / "street"
    unfinished = drivesplat.open(folder, device="cpu")
    (folder / "checkpoint.npz").unlink()
    with pytest.raises(RequestError, match="has not finished"):
        export_alpasim(tmp_path / "a.usdz", unfinished, AlpasimJob(), drive.provenance)
    assert not (tmp_path / "a.usdz").exists()
