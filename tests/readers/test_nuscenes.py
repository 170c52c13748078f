"""Reading nuScenes tables: poses and boxes compared with the tiny drive's geometry, and the message of every fault."""

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
from PIL import Image
from pyquaternion import Quaternion

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.readers.nuscenes import layout
from drivesplat.readers.nuscenes.layout import TABLES, find_root, table_files
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.scene import Scene
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


def test_the_scene_has_the_images_sweeps_and_sensors_of_the_tiny_drive(scene):
    assert (scene.name, scene.dataset, scene.version, scene.poses) == ("0001", "tiny", "v1.0-mini", "nuscenes")
    assert (scene.description, scene.key_frame_range, scene.missing_images) == ("tiny", None, 0)
    np.testing.assert_array_equal(scene.key_frame_timestamps, START_US + KEY_FRAME_US * np.arange(10))
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
    assert [sweep.timestamp for sweep in scene.sweeps] == [START_US + i * KEY_FRAME_US for i in range(10)]
    for sweep in scene.sweeps:
        expected = World().ego_at(seconds_of(sweep.timestamp)) + LIDAR_AT
        np.testing.assert_allclose(sweep.sensor_to_world[:3, 3], expected, atol=1e-6)
        assert sweep.is_key_frame and Path(sweep.path).is_file() and sweep.lidar == "LIDAR_TOP"
    (camera,), (lidar,) = scene.cameras, scene.lidars
    assert (camera.name, camera.width, camera.height) == ("CAM_FRONT", 96, 54)
    np.testing.assert_array_equal(camera.intrinsics, World().intrinsics)
    assert not camera.distortion.any() and camera.readout_s is None and camera.readout_direction is None
    np.testing.assert_allclose(np.degrees(lidar.beam_elevations[[0, -1]]), [-30.67, 10.67])


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


def test_the_origin_is_the_first_ego_position(root):
    np.testing.assert_array_equal(extract_scene(source(), root).origin, ORIGIN)
    edit(root, "ego_pose", lambda poses: row(poses, "0001 LIDAR_TOP 0").update(translation=[1.5, -2.5, 3.5]))
    np.testing.assert_array_equal(extract_scene(source(), root).origin, [1.5, -2.5, 3.5])


def test_every_image_and_sweep_uses_its_own_ego_pose_and_calibration(root):
    random = np.random.default_rng(3)
    expected = {}

    def scatter(rows: list[dict], around: np.ndarray, by: float) -> None:
        for it in rows:
            rotation, translation = Quaternion(random.normal(size=4)).unit, around + random.normal(0, by, 3)
            it.update(rotation=list(rotation), translation=translation.tolist())
            expected[it["token"]] = pose_of(translation, rotation)

    edit(root, "ego_pose", lambda rows: scatter(rows, ORIGIN, 20))
    edit(root, "calibrated_sensor", lambda rows: scatter(rows, np.zeros(3), 1))
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


def test_unknown_scenes_cameras_and_frames_are_refused_with_those_there_are(tmp_path, tiny_root):
    root = write_world(tmp_path, World(scenes=("0001", "0007"), key_frames=2))
    assert extract_scene(source(scene="0007"), root).frames[0].token.startswith("0007")
    for where, changes, words in (
        (root, {"scene": "0061"}, r"0061.*0001, 0007"),
        (tiny_root, {"cameras": ("CAM_FRONT", "CAM_BACK")}, r"CAM_BACK.*CAM_FRONT"),
        (tiny_root, {"frames": (10, 12)}, r"0001.*10"),
    ):
        with pytest.raises(DatasetError, match=words):
            extract_scene(source(**changes), where)


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


def test_boxes_keep_their_heading_and_visibility_and_a_track_may_have_one(root):
    """An object's x axis is its front; a rotation about z by 90 degrees turns it from x to y, and rotations are rounded
    to about 1e-4."""
    half, first = np.sqrt(0.5) * 1.0002, "0001 annotation 0 2"

    def turn(boxes: list[dict]) -> list[dict]:
        levels = {"0001 annotation 1 0": "1", "0001 annotation 1 1": ""}
        kept = [box for box in boxes if "annotation 0 " not in box["token"] or box["token"] == first]
        row(kept, first).update(prev="", next="")
        rotation = [half, 0.0, 0.0, half]
        return [{**it, "rotation": rotation, "visibility_token": levels.get(it["token"], "4")} for it in kept]

    ends = {"first_annotation_token": first, "last_annotation_token": first, "nbr_annotations": 1}
    edit(root, "sample_annotation", turn)
    edit(root, "instance", lambda instances: instances[0].update(ends))
    tracks = {track.category: track for track in extract_scene(source(), root).tracks}
    for track in tracks.values():
        np.testing.assert_allclose(track.object_to_world[0, :3, 0], [0.0, 1.0, 0.0], atol=1e-9)
    assert tracks["vehicle.car"].sample_indices.tolist() == [2]
    assert tracks["vehicle.truck"].visibility.tolist() == [1, 0, 4]


def test_the_dataroot_may_be_the_root_its_table_folder_or_its_parent(root, monkeypatch):
    monkeypatch.setenv("HOME", str(root.parent))
    for dataroot in (str(root), str(root / "v1.0-mini"), "~/nuscenes"):
        assert find_root(dataroot, "v1.0-mini") == root
    assert {file.stem for file in table_files(root, "v1.0-mini", "0001")} == set(TABLES)
    (root / "v1.0-mini/ego_pose.json").unlink()
    with pytest.raises(DatasetError, match=r"ego_pose\.json.*nuscenes\.org"):
        table_files(root, "v1.0-mini", "0001")
    around = root.parent / "around"
    around.mkdir()
    root.rename(around / "v1.0-mini")
    assert find_root(str(around), "v1.0-mini") == around / "v1.0-mini"


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


def image_of(root: Path, index: int) -> Path:
    return root / "samples" / "CAM_FRONT" / f"0001__{2 * index:04}.jpg"


HUGE = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
"""The header of a PNG of 60,000 x 60,000 pixels, which Pillow refuses to decode."""
FAULTS = {
    "missing": Path.unlink,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "no image": lambda path: path.write_bytes(b"no image at all" * 30),
    "empty": lambda path: path.write_bytes(b""),
    "small": lambda path: Image.new("RGB", (24, 13)).save(path),
    "deep": lambda path: Image.fromarray(np.full((27, 48), 40_000, np.uint16)).save(path, format="PNG"),
    "huge": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\r" + HUGE + struct.pack(">I", zlib.crc32(HUGE))),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_image_stops_the_extraction_naming_key_frame_token_and_path(root, fault):
    FAULTS[fault](image_of(root, 1))
    with pytest.raises(DatasetError) as failure:
        extract_scene(source(), root)
    for part in ("key frame 1", "0001 CAM_FRONT 2", str(image_of(root, 1)), "on_missing"):
        assert part in str(failure.value)


def test_a_bad_image_is_skipped_and_counted_with_on_missing_warn(root, caplog):
    for index, fault in enumerate(("missing", "deep")):
        FAULTS[fault](image_of(root, index))
    with caplog.at_level(logging.WARNING):
        scene = extract_scene(source(on_missing="warn"), root)
    assert scene.missing_images == 2
    assert [frame.sample_index for frame in scene.frames] == [2]
    assert len(scene.key_frame_timestamps) == 3
    assert str(image_of(root, 1)) in caplog.text and "0001 CAM_FRONT 0" in caplog.text
    shutil.rmtree(root / "samples" / "CAM_FRONT")
    with pytest.raises(DatasetError, match=r"0001.*3 images"):
        extract_scene(source(on_missing="warn"), root)


def sweep_of(root: Path, index: int) -> Path:
    return root / "samples" / "LIDAR_TOP" / f"0001__{index:04}.pcd.bin"


def seed_job(on_missing: str) -> SeedJob:
    seed = {"on_missing": on_missing, "far_points": 100}
    holdout = {"every_nth": 0, "last_block": 0}
    return SeedJob.model_validate({"lidar_seed": seed, "holdout": holdout, "images": {}, "random_seed": 0})


def in_millimetres(path: Path) -> None:
    (np.fromfile(path, np.float32).reshape(-1, 5) * [1000, 1000, 1000, 1, 1]).astype(np.float32).tofile(path)


SWEEP_FAULTS = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-7]),
    "random": lambda path: path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size)),
    "in millimetres": in_millimetres,
    "no numbers": lambda path: np.full((100, 5), np.nan, np.float32).tofile(path),
}


def test_a_bad_lidar_file_stops_the_seeding_naming_key_frame_token_and_path(root):
    scene, path = extract_scene(source(), root), sweep_of(root, 1)
    whole = path.read_bytes()
    for fault, damage in SWEEP_FAULTS.items():
        damage(path)
        with pytest.raises(DatasetError) as failure:
            seed_points(scene, seed_job("stop"))
        for part in ("key frame 1", "0001 LIDAR_TOP 1", str(path), "on_missing"):
            assert part in str(failure.value), fault
        path.write_bytes(whole)


def test_a_bad_lidar_file_is_counted_with_on_missing_warn(root, caplog):
    for index, fault in enumerate(("missing", "in millimetres")):
        SWEEP_FAULTS[fault](sweep_of(root, index))
    scene = extract_scene(source(), root)
    with caplog.at_level(logging.WARNING):
        points = seed_points(scene, seed_job("warn"))
    assert points.note["lidar_missing"] == 2 and points.note["lidar"] > 0
    assert str(sweep_of(root, 0)) in caplog.text and "left out" in caplog.text
    assert "restore it" not in caplog.text, "what has been decided is not asked again"


@pytest.mark.slow
def test_the_real_scene_has_its_frames_tracks_and_sweeps(real_scene_root):
    scene = extract_scene(source(dataset="nuscenes", scene="0061"), real_scene_root)
    assert len(scene.frames) == len(scene.sweeps) == len(scene.key_frame_timestamps) == 39
    assert len({tuple(frame.camera_to_world[:3, 3]) for frame in scene.frames}) == 39
    assert len(scene.tracks) == 239
    assert sum(len(track.timestamps) for track in scene.tracks) == 3408
    assert scene.key_frame_interval == pytest.approx(500_000, rel=0.02)
    assert sum(Path(sweep.path).is_file() for sweep in scene.sweeps) == 1


def test_the_returns_of_a_sweep_have_their_intensity_and_ring(root):
    sweep = extract_scene(source(), root).sweeps[1]
    file = np.array([[1.0, 2.0, 3.0, 51.0, 7.0], [np.nan, 0.0, 0.0, 1.0, 1.0], [4.0, 5.0, -6.0, 255.0, 31.0]])
    file.astype(np.float32).tofile(sweep.path)
    returns = read_returns(sweep)
    np.testing.assert_array_equal(returns.points, [[1.0, 2.0, 3.0], [4.0, 5.0, -6.0]])
    np.testing.assert_allclose(returns.intensity, [0.2, 1.0])
    assert returns.rings.tolist() == [7, 31] and returns.offsets_s is None
