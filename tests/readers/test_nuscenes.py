"""Reading nuScenes tables: poses and boxes compared with the tiny drive's geometry, and the message of every fault."""

import json
import logging
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers import drives
from helpers.drives import (
    CAMERA_AT,
    CAMERA_TO_EGO,
    KEY_FRAME_US,
    LIDAR_AT,
    ORIGIN,
    START_US,
    World,
    seconds_of,
    write_world,
)
from helpers.table_files import edit, row
from pyquaternion import Quaternion

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.readers.nuscenes import layout
from drivesplat.readers.nuscenes.layout import TABLES, find_root, table_files
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.lidar_seed import SeedJob

pytestmark = pytest.mark.usefixtures("uncompared")


def source(**changes) -> SceneSource:
    return drives.source(**{"sweeps": False, **changes})


@pytest.fixture
def root(small_root, tmp_path) -> Path:
    """A copy of a small drive that a test may damage."""
    return Path(shutil.copytree(small_root, tmp_path / "nuscenes"))


@pytest.fixture(scope="module")
def scene(tiny_root) -> Scene:
    """The tiny drive's key frames."""
    return extract_scene(source(), tiny_root)


def pose_of(translation, rotation) -> np.ndarray:
    pose = Quaternion(rotation).transformation_matrix
    pose[:3, 3] = translation
    return pose


def test_key_frame_images_have_the_camera_poses_of_the_tiny_drive(scene):
    assert [frame.sample_index for frame in scene.frames] == list(range(10))
    for i, frame in enumerate(scene.frames):
        assert frame.timestamp == START_US + i * KEY_FRAME_US - 35_000
        expected = World().ego_at(seconds_of(frame.timestamp))
        np.testing.assert_allclose(frame.ego_to_world[:3, 3], expected, atol=1e-6)
        np.testing.assert_allclose(frame.camera_to_world[:3, 3], expected + CAMERA_AT, atol=1e-6)
        np.testing.assert_allclose(frame.camera_to_world[:3, :3], CAMERA_TO_EGO, atol=1e-9)
        np.testing.assert_array_equal(frame.intrinsics, World().intrinsics)
        assert (frame.width, frame.height, frame.camera, frame.is_key_frame) == (96, 54, "CAM_FRONT", True)
        assert Path(frame.image_path).is_file()


def test_lidar_sweeps_have_the_lidar_poses_of_the_tiny_drive(scene):
    assert [sweep.timestamp for sweep in scene.sweeps] == [START_US + i * KEY_FRAME_US for i in range(10)]
    for sweep in scene.sweeps:
        expected = World().ego_at(seconds_of(sweep.timestamp)) + LIDAR_AT
        np.testing.assert_allclose(sweep.sensor_to_world[:3, 3], expected, atol=1e-6)
        assert sweep.is_key_frame and Path(sweep.path).is_file()


def test_without_cameras_a_scene_has_its_sweeps_and_boxes_alone(tiny_root):
    alone, with_images = (extract_scene(source(cameras=cameras), tiny_root) for cameras in ((), ("CAM_FRONT",)))
    assert alone.frames == alone.cameras == () and alone.lidars[0].name == "LIDAR_TOP"
    for name in ("sweeps", "tracks"):
        assert len(getattr(alone, name)) == len(getattr(with_images, name)) > 0
    np.testing.assert_array_equal(alone.origin, with_images.origin)
    np.testing.assert_array_equal(alone.key_frame_timestamps, with_images.key_frame_timestamps)


def test_missing_devkit_is_reported_with_the_command_that_installs_it(root, monkeypatch):
    monkeypatch.setattr(layout, "find_spec", lambda name: None)
    with pytest.raises(DatasetError, match=r"nuscenes-devkit.*is not installed: pip install --no-deps"):
        extract_scene(source(), root)


def test_names_and_times_of_the_scene_match_the_tables(scene):
    assert (scene.name, scene.dataset, scene.version, scene.poses) == ("0001", "tiny", "v1.0-mini", "nuscenes")
    assert (scene.description, scene.key_frame_range, scene.missing_images) == ("tiny", None, 0)
    np.testing.assert_array_equal(scene.key_frame_timestamps, START_US + KEY_FRAME_US * np.arange(10))
    assert scene.key_frame_interval == KEY_FRAME_US


def test_the_origin_is_the_first_ego_position(root):
    np.testing.assert_array_equal(extract_scene(source(), root).origin, ORIGIN)
    edit(root, "ego_pose", lambda poses: row(poses, "0001 LIDAR_TOP 0").update(translation=[1.5, -2.5, 3.5]))
    np.testing.assert_array_equal(extract_scene(source(), root).origin, [1.5, -2.5, 3.5])


def test_every_image_and_sweep_uses_its_own_ego_pose_and_calibration(root):
    random = np.random.default_rng(3)
    expected = {}

    def scatter(poses):
        for pose in poses:
            rotation, translation = Quaternion(random.normal(size=4)).unit, ORIGIN + random.normal(0, 20, 3)
            pose.update(rotation=list(rotation), translation=translation.tolist())
            expected[pose["token"]] = pose_of(translation, rotation)

    def turn(sensors):
        for sensor in sensors:
            rotation, translation = Quaternion(random.normal(size=4)).unit, random.normal(size=3)
            sensor.update(rotation=list(rotation), translation=translation.tolist())
            expected[sensor["token"]] = pose_of(translation, rotation)

    edit(root, "ego_pose", scatter)
    edit(root, "calibrated_sensor", turn)
    scene = extract_scene(source(sweeps=True), root)
    shift = np.eye(4)
    shift[:3, 3] = -expected["0001 LIDAR_TOP 0"][:3, 3]
    assert len(scene.frames) == 5 and len(scene.sweeps) == 3
    for frame in scene.frames:
        np.testing.assert_allclose(frame.ego_to_world, shift @ expected[frame.token], atol=1e-9)
        global_pose = expected[frame.token] @ expected["calibrated CAM_FRONT"]
        np.testing.assert_allclose(frame.camera_to_world, shift @ global_pose, atol=1e-9)
    for sweep in scene.sweeps:
        global_pose = expected[sweep.token] @ expected["calibrated LIDAR_TOP"]
        np.testing.assert_allclose(sweep.sensor_to_world, shift @ global_pose, atol=1e-9)


def test_an_image_between_key_frames_is_assigned_to_the_nearest_key_frame(tmp_path):
    scene = extract_scene(source(sweeps=True), write_world(tmp_path, World(key_frames=3, sweeps_between=5)))
    for frame in scene.frames:
        nearest = round((frame.timestamp - START_US) / KEY_FRAME_US)
        assert frame.sample_index == nearest


def test_a_frame_range_keeps_those_key_frames_counted_from_0(tiny_root):
    scene = extract_scene(source(frames=(3, 7), sweeps=True), tiny_root)
    whole = extract_scene(source(sweeps=True), tiny_root)
    assert scene.key_frame_range == [3, 7]
    np.testing.assert_array_equal(scene.key_frame_timestamps, whole.key_frame_timestamps[3:7])
    assert [f.token for f in scene.frames] == [f.token for f in whole.frames[6:13]]
    assert [f.sample_index for f in scene.frames if f.is_key_frame] == [0, 1, 2, 3]
    assert [s.token for s in scene.sweeps] == [s.token for s in whole.sweeps[3:7]]
    np.testing.assert_allclose(scene.origin, ORIGIN + World().ego_at(1.5))
    for track in scene.tracks:
        np.testing.assert_array_equal(track.sample_indices, np.arange(4))
        np.testing.assert_array_equal(track.timestamps, scene.key_frame_timestamps)


@pytest.mark.parametrize("frames", [(10, 12), (50, 60)])
def test_a_frame_range_beyond_the_scene_is_refused(tiny_root, frames):
    with pytest.raises(DatasetError, match=r"0001.*10"):
        extract_scene(source(frames=frames), tiny_root)


def test_an_unknown_scene_is_refused_with_the_available_scenes(tmp_path):
    root = write_world(tmp_path, World(scenes=("0001", "0007"), key_frames=2))
    with pytest.raises(DatasetError, match=r"0061.*0001, 0007"):
        extract_scene(source(scene="0061"), root)
    assert extract_scene(source(scene="0007"), root).frames[0].token.startswith("0007")


def test_an_unknown_camera_is_refused_with_the_available_sensors(tiny_root):
    with pytest.raises(DatasetError, match=r"CAM_BACK.*CAM_FRONT"):
        extract_scene(source(cameras=("CAM_FRONT", "CAM_BACK")), tiny_root)


def test_tracks_match_the_objects_of_the_tiny_drive(scene):
    things = {thing.category: thing for thing in World().things}
    assert len(scene.tracks) == len(things)
    for track in scene.tracks:
        np.testing.assert_array_equal(track.timestamps, scene.key_frame_timestamps)
        np.testing.assert_array_equal(track.sample_indices, np.arange(10))
        np.testing.assert_array_equal(track.visibility, np.full(10, 4))
        assert track.size.tolist() == list(things[track.category].size), "length, width, height"
        expected = [things[track.category].at(seconds_of(time)) for time in track.timestamps]
        np.testing.assert_allclose(track.object_to_world[:, :3, 3], expected, atol=1e-9)


def test_a_box_turned_to_the_left_points_to_the_left(root):
    """An object's x axis is its front; a rotation about z by 90 degrees turns it from x to y."""
    half = np.sqrt(0.5)
    edit(root, "sample_annotation", lambda boxes: [{**box, "rotation": [half, 0.0, 0.0, half]} for box in boxes])
    for track in extract_scene(source(), root).tracks:
        np.testing.assert_allclose(track.object_to_world[0, :3, 0], [0.0, 1.0, 0.0], atol=1e-9)


def test_a_track_with_one_box_is_kept(root):
    def keep_one(boxes):
        return [box for box in boxes if "annotation 0 " not in box["token"] or box["token"].endswith(" 2")]

    edit(root, "sample_annotation", keep_one)
    edit(
        root,
        "instance",
        lambda instances: instances[0].update(
            first_annotation_token="0001 annotation 0 2", last_annotation_token="0001 annotation 0 2", nbr_annotations=1
        ),
    )
    edit(root, "sample_annotation", lambda boxes: row(boxes, "0001 annotation 0 2").update(prev="", next=""))
    (track,) = [t for t in extract_scene(source(), root).tracks if t.category == "vehicle.car"]
    assert track.sample_indices.tolist() == [2]
    (car,) = [thing for thing in World().things if thing.category == "vehicle.car"]
    np.testing.assert_allclose(track.object_to_world[0, :3, 3], car.at(2 * KEY_FRAME_US * 1e-6), atol=1e-9)


@pytest.mark.parametrize("token", ["1", "4", ""])
def test_visibility_is_the_level_in_the_tables_or_0(root, token):
    edit(root, "sample_annotation", lambda boxes: [{**box, "visibility_token": token} for box in boxes])
    assert {int(v) for track in extract_scene(source(), root).tracks for v in track.visibility} == {int(token or 0)}


def test_the_dataroot_may_be_the_root_its_table_folder_or_its_parent(root):
    assert find_root(str(root), "v1.0-mini") == root
    assert find_root(str(root / "v1.0-mini"), "v1.0-mini") == root
    around = root.parent / "around"
    around.mkdir()
    root.rename(around / "v1.0-mini")
    assert find_root(str(around), "v1.0-mini") == around / "v1.0-mini"


def test_the_dataroot_may_start_with_a_tilde(root, monkeypatch):
    monkeypatch.setenv("HOME", str(root.parent))
    assert find_root("~/nuscenes", "v1.0-mini") == root


def test_a_dataroot_without_the_version_is_refused_with_its_path_and_what_to_do(root, tmp_path):
    """Also a typo that names a folder beside the dataset."""
    for folder in (tmp_path / "empty", root / "maps-of-mine"):
        folder.mkdir()
    for dataroot, version, said in (
        (tmp_path / "absent", "v1.0-mini", "nuscenes.org"), (tmp_path / "empty", "v1.0-mini", "nuscenes.org"),
        (root, "v1.0-trainval", "v1.0-mini"), (root / "maps-of-mine", "v1.0-mini", "v1.0-mini"),
    ):  # fmt: skip
        with pytest.raises(DatasetError) as failure:
            find_root(str(dataroot), version)
        message = str(failure.value)
        assert "\n" not in message and version in message and str(dataroot) in message and said in message


def test_an_incomplete_dataset_is_refused_with_the_missing_tables(root, table="ego_pose"):
    (root / "v1.0-mini" / f"{table}.json").unlink()
    with pytest.raises(DatasetError, match=rf"{table}\.json.*nuscenes\.org"):
        table_files(root, "v1.0-mini", "0001")


def test_the_table_files_are_all_tables_of_the_version(root):
    assert {file.stem for file in table_files(root, "v1.0-mini", "0001")} == set(TABLES)
    assert {file.stem for file in (root / "v1.0-mini").iterdir()} == set(TABLES)


def image_of(root: Path, index: int) -> Path:
    return root / "samples" / "CAM_FRONT" / f"0001__{2 * index:04}.jpg"


def remove(path: Path) -> None:
    path.unlink()


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def scramble(path: Path) -> None:
    path.write_bytes(b"no image at all" * 30)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def shrink(path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (24, 13)).save(path)


def deepen(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.full((27, 48), 40_000, np.uint16)).save(path, format="PNG")


def inflate(path: Path) -> None:
    """A PNG whose header says 60,000 x 60,000 pixels, which Pillow refuses to decode."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\r" + header + struct.pack(">I", zlib.crc32(header)))


FAULTS = [remove, truncate, scramble, empty, shrink, deepen, inflate]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_image_stops_the_extraction_naming_key_frame_token_and_path(root, fault):
    fault(image_of(root, 1))
    with pytest.raises(DatasetError) as failure:
        extract_scene(source(), root)
    for part in ("key frame 1", "0001 CAM_FRONT 2", str(image_of(root, 1)), "on_missing"):
        assert part in str(failure.value)


@pytest.mark.parametrize("fault", [remove, deepen])
def test_a_bad_image_is_skipped_and_counted_with_on_missing_warn(root, fault, caplog):
    fault(image_of(root, 0))
    fault(image_of(root, 1))
    with caplog.at_level(logging.WARNING):
        scene = extract_scene(source(on_missing="warn"), root)
    assert scene.missing_images == 2
    assert [frame.sample_index for frame in scene.frames] == [2]
    assert len(scene.key_frame_timestamps) == 3
    assert str(image_of(root, 1)) in caplog.text and "0001 CAM_FRONT 0" in caplog.text


def test_a_drive_without_a_readable_image_is_an_error_even_with_on_missing_warn(root):
    shutil.rmtree(root / "samples" / "CAM_FRONT")
    with pytest.raises(DatasetError, match=r"0001.*3 images"):
        extract_scene(source(on_missing="warn"), root)


def sweep_of(root: Path, index: int) -> Path:
    return root / "samples" / "LIDAR_TOP" / f"0001__{index:04}.pcd.bin"


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def random_bytes(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))


def far(path: Path) -> None:
    """Coordinates in millimetres."""
    (np.fromfile(path, np.float32).reshape(-1, 5) * [1000, 1000, 1000, 1, 1]).astype(np.float32).tofile(path)


def no_number(path: Path) -> None:
    np.full((100, 5), np.nan, np.float32).tofile(path)


def seed_job(on_missing: str) -> SeedJob:
    seed = {"on_missing": on_missing, "far_points": 100}
    holdout = {"every_nth": 0, "last_block": 0}
    return SeedJob.model_validate({"lidar_seed": seed, "holdout": holdout, "images": {}, "random_seed": 0})


@pytest.mark.parametrize("fault", [remove, empty, cut_off, random_bytes, far, no_number])
def test_a_bad_lidar_file_stops_the_seeding_naming_key_frame_token_and_path(root, fault):
    fault(sweep_of(root, 1))
    scene = extract_scene(source(), root)
    with pytest.raises(DatasetError) as failure:
        seed_points(scene, seed_job("stop"))
    for part in ("key frame 1", "0001 LIDAR_TOP 1", str(sweep_of(root, 1)), "on_missing"):
        assert part in str(failure.value)


@pytest.mark.parametrize("fault", [remove, far])
def test_a_bad_lidar_file_is_counted_with_on_missing_warn(root, fault, caplog):
    for index in (0, 1):
        fault(sweep_of(root, index))
    scene = extract_scene(source(), root)
    with caplog.at_level(logging.WARNING):
        points = seed_points(scene, seed_job("warn"))
    assert points.note["lidar_missing"] == 2
    assert points.note["lidar"] > 0
    assert str(sweep_of(root, 0)) in caplog.text and "left out" in caplog.text
    assert "restore it" not in caplog.text, "what has been decided is not asked again"


def test_a_quaternion_of_nearly_unit_length_is_accepted(root):
    """The tables are rounded: lengths deviate by up to about 1e-4."""
    edit(root, "ego_pose", lambda poses: [{**pose, "rotation": [1.0002, 0.0, 0.0, 0.0]} for pose in poses])
    scene = extract_scene(source(), root)
    np.testing.assert_allclose(scene.frames[0].ego_to_world[:3, :3], np.eye(3), atol=1e-9)


@pytest.fixture(scope="module")
def real_scene(real_scene_root) -> Scene:
    return extract_scene(source(dataset="nuscenes", scene="0061"), real_scene_root)


@pytest.mark.slow
def test_the_real_scene_has_its_frames_tracks_and_sweeps(real_scene):
    assert len(real_scene.frames) == len(real_scene.sweeps) == len(real_scene.key_frame_timestamps) == 39
    assert len(real_scene.tracks) == 239
    assert sum(len(track.timestamps) for track in real_scene.tracks) == 3408
    assert real_scene.key_frame_interval == pytest.approx(500_000, rel=0.02)
    assert sum(Path(sweep.path).is_file() for sweep in real_scene.sweeps) == 1


@pytest.mark.slow
def test_the_real_scenes_images_have_their_own_poses(real_scene, real_scene_root):
    """Compared with the tables: camera pose = ego pose of the image's own record x calibration."""
    read = {
        table: {r["token"]: r for r in json.loads((real_scene_root / "v1.0-mini" / f"{table}.json").read_text())}
        for table in ("sample_data", "ego_pose", "calibrated_sensor")
    }
    first = next(f for f in real_scene.sweeps)
    origin = read["ego_pose"][read["sample_data"][first.token]["ego_pose_token"]]["translation"]
    np.testing.assert_allclose(real_scene.origin, origin)
    apart = []
    for frame, sweep in zip(real_scene.frames, real_scene.sweeps, strict=True):
        expected = camera_pose(read, frame)
        expected[:3, 3] -= origin
        np.testing.assert_allclose(frame.camera_to_world, expected, atol=1e-6)
        lidar = read["ego_pose"][read["sample_data"][sweep.token]["ego_pose_token"]]["translation"]
        apart.append(np.linalg.norm(frame.ego_to_world[:3, 3] + origin - lidar))
    assert len({tuple(frame.camera_to_world[:3, 3]) for frame in real_scene.frames}) == 39
    assert np.median(apart) > 0.1, "camera and LiDAR fire at different times, so their ego poses differ"


def camera_pose(tables: dict, frame: Frame) -> np.ndarray:
    data = tables["sample_data"][frame.token]
    ego, sensor = (
        tables["ego_pose"][data["ego_pose_token"]],
        tables["calibrated_sensor"][data["calibrated_sensor_token"]],
    )
    return pose_of(ego["translation"], ego["rotation"]) @ pose_of(sensor["translation"], sensor["rotation"])


def test_the_scene_describes_the_sensors_of_the_tiny_drive(scene):
    (camera,), (lidar,) = scene.cameras, scene.lidars
    assert (camera.name, camera.width, camera.height) == ("CAM_FRONT", 96, 54)
    np.testing.assert_array_equal(camera.intrinsics, World().intrinsics)
    assert not camera.distortion.any() and camera.readout_s is None and camera.readout_direction is None
    assert lidar.name == "LIDAR_TOP" and {sweep.lidar for sweep in scene.sweeps} == {lidar.name}
    np.testing.assert_allclose(np.degrees(lidar.beam_elevations[[0, -1]]), [-30.67, 10.67])


def test_the_returns_of_a_sweep_have_their_intensity_and_ring(root):
    sweep = extract_scene(source(), root).sweeps[1]
    file = np.array([[1.0, 2.0, 3.0, 51.0, 7.0], [np.nan, 0.0, 0.0, 1.0, 1.0], [4.0, 5.0, -6.0, 255.0, 31.0]])
    file.astype(np.float32).tofile(sweep.path)
    returns = read_returns(sweep)
    np.testing.assert_array_equal(returns.points, [[1.0, 2.0, 3.0], [4.0, 5.0, -6.0]])
    np.testing.assert_allclose(returns.intensity, [0.2, 1.0])
    assert returns.rings.tolist() == [7, 31] and returns.offsets_s is None
