"""Drives as MCAP files: read back by rosbags, and compared with what they were made of."""

import dataclasses
import json
import struct
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import AHEAD, SPEED, TURNING, checkpoint_of, straight, street_scene
from helpers.mcap_files import Recording, columns_of, nanoseconds, pose_of, records_of
from helpers.scanned_street import REVOLUTION_S, scan_records, scanned_street
from PIL import Image

from drivesplat.cli.__main__ import main
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.editing.drive_folder import write_rendered_drive
from drivesplat.editing.scan_folder import write_scan_folder
from drivesplat.errors import DatasetError, DriveSplatError, RequestError, ResultError
from drivesplat.export import ros_messages
from drivesplat.export.drive_clouds import rendered_sweeps
from drivesplat.export.drive_mcap import DriveMessages, EgoTimeline, write_mcap
from drivesplat.export.ros_messages import camera_info
from drivesplat.io.storage import no_provenance
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.drive.write import write_drive
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Camera
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.export import DriveJob, ScanFolderJob
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.render import TrajectorySettings
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.run_folder import write_run_drive

CPU = DeviceSettings(kind="cpu")
EDIT = [{"shift": {"track": AHEAD, "lateral": 2.0}}, {"remove": {"track": TURNING}}]
CLOUDS, IMAGES, INFO = "/LIDAR_TOP/points", "/CAM_FRONT/image_raw/compressed", "/CAM_FRONT/camera_info"
BOXES, MARKERS = "/objects/detections", "/objects/markers"
TYPES = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    IMAGES: "sensor_msgs/msg/CompressedImage",
    INFO: "sensor_msgs/msg/CameraInfo",
    CLOUDS: "sensor_msgs/msg/PointCloud2",
    MARKERS: "visualization_msgs/msg/MarkerArray",
    BOXES: "vision_msgs/msg/Detection3DArray",
}


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture(scope="module")
def drive(scene, tmp_path_factory) -> TrainedDrive:
    """The street of `scanned_street`, which renders LiDAR."""
    return drive_of(scene, scanned_street(scene), tmp_path_factory.mktemp("recorded"), scan_records(scene))


def rendered(scene: Scene, folder: Path, steps: list[dict[str, Any]], scans: slice = slice(None)) -> Path:
    """The street after an edit, or as recorded without steps: drive/ and `scans` of it in scans/ in `folder`."""
    checkpoint = checkpoint_of(scanned_street(scene))
    edit = Edit.model_validate({"steps": steps}) if steps else None
    source = {"scene": "0001", "method": "street", **({"edit": "busy"} if steps else {"trajectory": "original"})}
    trajectory = None if steps else TrajectorySettings()
    job = DriveJob(
        eval_camera="CAM_FRONT", cameras=("CAM_FRONT",), images=ImageSettings(), edit=edit, trajectory=trajectory,
        holdout=HoldoutSettings(every_nth=0, last_block=2), width=64,
    )  # fmt: skip
    write_rendered_drive(scene, checkpoint, job, CPU, folder / "drive/drive.json", source, no_provenance())
    of_scans = ScanFolderJob(eval_camera="CAM_FRONT", formats=("npz",), edit=edit, trajectory=trajectory)
    path, every = folder / "scans/scans.json", scan_records(scene)
    some = dataclasses.replace(every, scans=every.scans[scans])
    write_scan_folder(scene, checkpoint, some, of_scans, CPU, path, source, no_provenance())
    return folder


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory) -> Path:
    return rendered(scene, tmp_path_factory.mktemp("original"), [])


@pytest.fixture(scope="module")
def file(folder) -> Path:
    write_mcap(folder / "drive", folder / "drive.mcap", folder / "scans/scans.json", {"stages": {"a": 1}})
    return folder / "drive.mcap"


@pytest.fixture(scope="module")
def recording(file) -> Recording:
    return Recording.of(file)


def test_topics_have_their_types_counts_and_stamps_in_order(recording, scene, folder):
    assert recording.types == TYPES
    frames = json.loads((folder / "drive/drive.json").read_text())["frames"]
    counts = {topic: len(messages) for topic, messages in recording.messages.items()}
    assert counts[IMAGES] == counts[INFO] == counts["/odom"] == len(frames) == len(scene.frames)
    assert counts[CLOUDS] == len(scene.sweeps) and counts[BOXES] == counts[MARKERS] > 40
    assert counts["/tf"] == len(recording.ego) and counts["/tf_static"] == 1
    assert recording.order == sorted(recording.order, key=lambda one: one[0])
    for topic in (IMAGES, INFO, CLOUDS, BOXES, "/odom"):
        for time, message in recording.messages[topic]:
            assert time == nanoseconds(message.header)
    assert [time for time, _ in recording.messages[IMAGES]] == [1000 * frame["timestamp"] for frame in frames]


def test_static_transforms_are_latched_and_all_frames_hang_on_the_map(recording):
    kept = {topic for topic, quality in recording.qualities.items() if quality.durability.name == "TRANSIENT_LOCAL"}
    assert kept == {"/tf_static"}
    assert all(quality.reliability.name == "RELIABLE" for quality in recording.qualities.values())
    assert set(recording.static) == {"CAM_FRONT_optical_frame", "LIDAR_TOP"}
    used = {message.header.frame_id for topic in (IMAGES, INFO, CLOUDS) for message in recording.all(topic)}
    assert used == set(recording.static)
    assert {message.header.frame_id for topic in (BOXES, "/odom") for message in recording.all(topic)} == {"map"}


def test_images_are_the_files_and_show_what_the_drive_renders(recording, folder, drive, scene):
    frames = sorted(scene.frames, key=lambda frame: frame.timestamp)
    for i, (frame, message) in enumerate(zip(frames, recording.all(IMAGES), strict=True)):
        path = folder / f"drive/images/CAM_FRONT/{frame.timestamp}.jpg"
        assert message.format == "jpeg" and message.data.tobytes() == path.read_bytes()
        if i % 6:
            continue
        found = np.asarray(Image.open(BytesIO(message.data.tobytes()))).astype(int)
        info = recording.all(INFO)[i]
        K = info.k.reshape(3, 3) + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        camera = dataclasses.replace(drive.camera("CAM_FRONT"), K=K, width=info.width, height=info.height)
        seconds = scene.seconds(frame.timestamp)
        shown = drive.render(camera, seconds, camera_to_world=frame.camera_to_world).image
        assert shown.shape == found.shape and np.abs(found - shown).mean() < 1.5


def test_intrinsics_count_pixels_from_the_centre_of_the_first(recording, scene):
    """The file's images are 64 pixels wide, the recorded ones 96: edges, at -0.5, stay edges."""
    info, recorded = recording.all(INFO)[0], scene.frames[0].intrinsics
    scale = 64 / 96
    expected = (recorded[:2, 2] + 0.5) * scale - 0.5
    np.testing.assert_allclose(info.k.reshape(3, 3)[:2, 2], expected, atol=1e-9)
    np.testing.assert_allclose(info.k.reshape(3, 3)[0, 0], recorded[0, 0] * scale)
    assert (info.width, info.height, info.distortion_model) == (64, 36, "plumb_bob") and not info.d.any()
    np.testing.assert_array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
    np.testing.assert_array_equal(info.r, np.eye(3).ravel())


@pytest.mark.parametrize(
    ("model", "given", "name", "written"),
    [
        ("opencv", [0.1, 0.2, 0.3, 0.4], "plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.0]),
        ("opencv", [0.1] * 8, "rational_polynomial", [0.1] * 8),
        ("fisheye", [0.1, 0.2, 0.3, 0.4], "equidistant", [0.1, 0.2, 0.3, 0.4]),
        ("mei", [1.0, 0.1, 0.2, 0.3, 0.4], "mei", [1.0, 0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_lenses_have_the_names_of_ros(model, given, name, written):
    found = camera_info(5, "front", Camera("", 64, 48, np.eye(3), np.array(given), distortion_model=model))
    assert found.distortion_model == name and found.d.tolist() == written


@pytest.mark.parametrize("number", [0, 4, 8])
def test_clouds_lie_in_the_map_where_the_drive_scans_them(recording, drive, scene, number):
    scan = drive.scan("LIDAR_TOP", scene.seconds(scene.sweeps[number].timestamp))
    returned = scan.arrays()["returned"]
    columns = columns_of(recording.all(CLOUDS)[number])
    np.testing.assert_allclose(recording.points(CLOUDS, number), scan.points(), atol=5e-3)
    np.testing.assert_array_equal(columns["ring"], np.nonzero(returned)[0])
    np.testing.assert_allclose(columns["intensity"], scan.arrays()["intensity"][returned], atol=1e-3)


def test_a_cloud_is_stamped_at_the_begin_of_its_revolution(recording, scene):
    for sweep, cloud in zip(scene.sweeps, recording.all(CLOUDS), strict=True):
        assert abs(nanoseconds(cloud.header) - 1000 * sweep.timestamp + 1e9 * REVOLUTION_S) <= 1000
    rays = scan_records(scene).scans[4].scan.rays
    columns = columns_of(recording.all(CLOUDS)[4])
    assert columns["t"].dtype == np.uint32 and columns["ring"].dtype == np.uint16
    ends = 1000 * scene.sweeps[4].timestamp - nanoseconds(recording.all(CLOUDS)[4].header)
    known = np.rint(1e9 * rays.offsets_s[0].astype(np.float64)) + ends
    assert np.isin(columns["t"], known.astype(np.int64)).all() and len(np.unique(columns["t"])) > 20


def test_boxes_are_where_the_objects_drive(recording, scene):
    tracks = {track.id: track for track in scene.tracks}
    seen = 0
    for message in recording.all(BOXES):
        seconds = scene.seconds(nanoseconds(message.header) // 1000)
        for one in message.detections:
            track, (result,) = tracks[one.id], one.results
            assert result.hypothesis.class_id == track.object_class.value and result.hypothesis.score == 1.0
            np.testing.assert_allclose([one.bbox.size.x, one.bbox.size.y, one.bbox.size.z], track.size, atol=1e-6)
            if one.id == AHEAD and 0.1 < seconds < 4.4:
                np.testing.assert_allclose(pose_of(one.bbox.center), straight(seconds), atol=1e-3)
                seen += 1
    assert seen > 30


def test_markers_are_the_boxes_and_replace_those_before(recording):
    for drawn, known in zip(recording.all(MARKERS), recording.all(BOXES), strict=True):
        first, *cubes = drawn.markers
        assert first.action == first.DELETEALL
        assert {cube.type for cube in cubes} <= {first.CUBE} and len({(one.ns, one.id) for one in cubes}) == len(cubes)
        for cube, one in zip(cubes, known.detections, strict=True):
            np.testing.assert_array_equal(pose_of(cube.pose), pose_of(one.bbox.center))
            assert cube.ns == one.results[0].hypothesis.class_id and cube.color.a > 0.0
            assert (cube.scale.x, cube.scale.y, cube.scale.z) == (one.bbox.size.x, one.bbox.size.y, one.bbox.size.z)


def test_odometry_is_the_ego_vehicle_of_the_scene(recording, scene):
    frames = {1000 * frame.timestamp: frame for frame in scene.frames}
    for time, message in recording.messages["/odom"]:
        np.testing.assert_allclose(pose_of(message.pose.pose), frames[time].ego_to_world, atol=1e-9)
        np.testing.assert_allclose(recording.ego[time], frames[time].ego_to_world, atol=1e-9)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        np.testing.assert_allclose([linear.x, linear.y, linear.z], [4.0, 0.0, 0.0], atol=1e-3)
        assert abs(angular.z) < 1e-3 and message.child_frame_id == "base_link"


def test_an_edited_drive_has_the_edit_in_boxes_images_and_clouds(scene, recording, tmp_path):
    folder = rendered(scene, tmp_path, EDIT, slice(4, 5))
    write_mcap(folder / "drive", tmp_path / "drive.mcap", folder / "scans/scans.json")
    edited = Recording.of(tmp_path / "drive.mcap")
    ids = {one.id for message in edited.all(BOXES) for one in message.detections}
    assert AHEAD in ids and TURNING not in ids
    before = {time: {one.id: one for one in message.detections} for time, message in recording.messages[BOXES]}
    for time, message in edited.messages[BOXES]:
        for one in message.detections:
            if one.id == AHEAD and time in before:
                moved = pose_of(one.bbox.center)[:3, 3] - pose_of(before[time][AHEAD].bbox.center)[:3, 3]
                np.testing.assert_allclose(moved, [0.0, 2.0, 0.0], atol=1e-6)
    assert edited.all(IMAGES)[4].data.tobytes() != recording.all(IMAGES)[4].data.tobytes()
    assert edited.all(CLOUDS)[0].data.tobytes() != recording.all(CLOUDS)[4].data.tobytes()


def test_a_run_has_the_driven_path_and_what_its_policy_saw(drive, tmp_path, caplog):
    job = RunJob.model_validate({
        "run": {
            "policy": "constant_speed", "policy_settings": {"speed": 6.0}, "seeds": [3],
            "simulation": {"seconds": 0.6, "start": 1.0, "width": 32, "lidar": "LIDAR_TOP", "end_on_collision": False},
        },
        "edit": {"steps": EDIT}, "code": None, "crf": 18,
    })  # fmt: skip
    source, path = {"scene": "0001", "method": "street", "run": "fast"}, tmp_path / "drive/drive.json"
    write_run_drive(drive, job, path, source, {"episodes": [{"path": [[1.0, 0.0, 0.0, 0.0]]}]}, no_provenance())
    assert "takes 6 steps in place of 0" in caplog.text
    counts = write_mcap(path.parent, tmp_path / "fast.mcap")
    assert counts[IMAGES] == counts[CLOUDS] == counts["/odom"] == 7
    found, record = Recording.of(tmp_path / "fast.mcap"), json.loads(path.read_text())
    assert record["rendered"]["run"] == "fast" and record["rendered"]["seed"] == 3
    driven = np.stack([pose_of(message.pose.pose)[:3, 3] for message in found.all("/odom")])
    began = drive.ego_to_world(1.0)[:3, 3]
    np.testing.assert_allclose(driven[0], began, atol=1e-6)
    assert np.linalg.norm(driven[-1] - began) > 0.6 * 4.0 + 0.1  # faster than recorded
    assert found.all("/odom")[-1].twist.twist.linear.x > 4.5
    scan = drive.edited(EDIT).state(1.0).scan("LIDAR_TOP")
    np.testing.assert_allclose(found.points(CLOUDS, 0), scan.points(), atol=5e-3)
    ids = {one.id for message in found.all(BOXES) for one in message.detections}
    assert AHEAD in ids and TURNING not in ids and record["rendered"]["shown_by"][AHEAD] == "own"


def test_a_run_that_cannot_be_recorded_leaves_nothing(drive, tmp_path):
    def written(**run: Any) -> None:
        job = RunJob.model_validate({"run": {"policy": "recorded", **run}, "edit": None, "code": None, "crf": 18})
        source = {"scene": "0001", "method": "street", "run": "blind"}
        write_run_drive(drive, job, tmp_path / "drive/drive.json", source, {"episodes": []}, no_provenance())

    with pytest.raises(RequestError, match="run blind has no sensor to record; name a camera"):
        written(simulation={"cameras": []})
    with pytest.raises(RequestError, match="there is no policy 'nobody'"):
        written(policy="nobody")
    assert not list(tmp_path.glob("drive/*"))


def test_messages_are_made_as_they_are_written(folder, monkeypatch):
    """Of a sensor no more than one message is ahead of those that are written, however long the drive."""
    drive = read_drive(folder / "drive")
    timeline, made = EgoTimeline.of(drive), []
    for name in ("jpeg_image", "point_cloud"):
        make = getattr(ros_messages, name)
        monkeypatch.setattr(ros_messages, name, lambda *given, make=make, name=name: made.append(name) or make(*given))
    sweeps = rendered_sweeps(folder / "scans/scans.json")
    written = []
    for _, topic, _ in DriveMessages(drive, folder / "drive", timeline, sweeps).in_order():
        written.append(topic)
        assert made.count("jpeg_image") <= written.count(IMAGES) + 1
        assert made.count("point_cloud") <= written.count(CLOUDS) + 1
    assert written.count(IMAGES) == len(drive.frames) and written.count(CLOUDS) == len(sweeps)


# ---- the container


def test_equal_drives_give_equal_bytes(folder, file, tmp_path):
    write_mcap(folder / "drive", tmp_path / "drive.mcap", folder / "scans/scans.json", {"stages": {"a": 1}})
    assert (tmp_path / "drive.mcap").read_bytes() == file.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]


def test_the_container_is_complete_without_rosbags(file, recording):
    """By the layout of the format: magic, header, chunks, summary; opcodes 1 header, 3 schema, 4 channel, 5 message, 6
    chunk, 11 statistics, 12 metadata."""
    data = file.read_bytes()
    assert data[:8] == data[-8:] == b"\x89MCAP0\r\n"
    records = records_of(data[8:-8])
    assert records[0][0] == 1 and records[0][1][4:8] == b"ros2" and records[-1][0] == 2
    inner = []
    for opcode, content in records:
        if opcode == 6:
            size, _, length = struct.unpack_from("<QII", content, 16)
            assert content[32 : 32 + length] == b"zstd"
            chunk = zstd.decompress(content[40 + length :])
            assert len(chunk) == size
            inner += records_of(chunk)
    messages = sum(opcode == 5 for opcode, _ in inner)
    (statistics,) = [content for opcode, content in records if opcode == 11]
    assert struct.unpack_from("<Q", statistics)[0] == messages == len(recording.order)
    schemas = b"".join(content for opcode, content in inner if opcode == 3)
    assert schemas.count(b"ros2msg") == len(set(TYPES.values()))
    assert b"MSG: vision_msgs/BoundingBox3D" in schemas and b"float64 score" in schemas
    (metadata,) = [content.decode(errors="replace") for opcode, content in records if opcode == 12]
    assert "relative_file_paths" in metadata and "drive.mcap" in metadata
    for note in ("Rendered by drivesplat, not recorded", '"trajectory": "original"', '{"stages": {"a": 1}}'):
        assert note.replace('"', '\\"') in metadata or note in metadata
    (summary_start,) = struct.unpack_from("<Q", records[-1][1])
    assert records_of(data[summary_start:-8])[0][0] == 3


# ---- other drive folders


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory) -> Path:
    """The recorded drive as a drive folder, with its sweeps."""
    return write_drive(scene, tmp_path_factory.mktemp("own") / "drive").parent


def changed(folder: Path, there: Path, change: Any = None) -> Path:
    """A copy of a drive folder whose drive.json is changed; its files are links."""
    there.mkdir()
    for part in ("images", "sweeps"):
        if (folder / part).exists():
            (there / part).symlink_to(folder / part)
    content = json.loads((folder / "drive.json").read_text())
    if change is not None:
        change(content)
    (there / "drive.json").write_text(json.dumps(content))
    return there


def test_a_recorded_drive_folder_has_its_images_and_returns(recorded, scene, tmp_path):
    counts = write_mcap(recorded, tmp_path / "own.mcap")
    found = Recording.of(tmp_path / "own.mcap")
    assert counts[IMAGES] == len(scene.frames) and counts[CLOUDS] == len(scene.sweeps)
    for number in (0, 5):
        returns, sweep = read_returns(scene.sweeps[number]), scene.sweeps[number]
        expected = apply(sweep.sensor_to_world, returns.points)
        np.testing.assert_allclose(found.points(CLOUDS, number), expected, atol=1e-4)
        assert "t" not in columns_of(found.all(CLOUDS)[number]).dtype.names
        assert nanoseconds(found.all(CLOUDS)[number].header) == 1000 * sweep.timestamp
    for frame, message in zip(scene.frames, found.all(IMAGES), strict=True):
        assert message.data.tobytes() == Path(frame.image_path).read_bytes()
        camera = found.ego[1000 * frame.timestamp] @ found.static["CAM_FRONT_optical_frame"]
        np.testing.assert_allclose(camera, frame.camera_to_world, atol=1e-6)


def test_returns_with_times_count_from_the_first_and_move_with_the_vehicle(recorded, tmp_path):
    """Sweeps in the sensor's frame at the timestamp, as motion-compensated ones; the vehicle drives 4 m/s."""
    folder = changed(recorded, tmp_path / "drive")
    (folder / "sweeps").unlink()
    sweep = json.loads((folder / "drive.json").read_text())["sweeps"][3]
    for one in json.loads((folder / "drive.json").read_text())["sweeps"]:
        (folder / one["file"]).parent.mkdir(parents=True, exist_ok=True)
        points = {"x": [5.0, 9.0], "y": [1.0, -2.0], "z": [0.5, 0.1], "time": [-0.05, 0.02], "ring": [3, 7]}
        np.savez(folder / one["file"], **{name: np.array(values) for name, values in points.items()})
    write_mcap(folder, tmp_path / "own.mcap")
    found = Recording.of(tmp_path / "own.mcap")
    cloud = found.all(CLOUDS)[3]
    columns = columns_of(cloud)
    assert nanoseconds(cloud.header) == 1000 * (sweep["timestamp"] - 50_000)
    assert columns["t"].tolist() == [0, 70_000_000] and columns["ring"].tolist() == [3, 7]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = sweep["lidar_to_world"]["rotation"], sweep["lidar_to_world"]["translation"]
    local = np.array([[5.0, 1.0, 0.5], [9.0, -2.0, 0.1]])
    np.testing.assert_allclose(found.points(CLOUDS, 3), apply(pose, local), atol=1e-4)
    moved = found.ego[nanoseconds(cloud.header)] @ found.static["LIDAR_TOP"]
    np.testing.assert_allclose(pose[:3, 3] - moved[:3, 3], [0.2, 0.0, 0.0], atol=1e-3)


def test_global_poses_are_relative_to_the_first(recorded, tmp_path):
    far = np.array([5e5, 4e6, 30.0])

    def change(content: dict[str, Any]) -> None:
        content["origin"] = None
        for one in content["frames"]:
            for name in ("camera_to_world", "ego_to_world"):
                one[name]["translation"] = (np.array(one[name]["translation"]) + far).tolist()
        for one in content["sweeps"]:
            place = np.array(one["lidar_to_world"]["translation"]) + far
            one["lidar_to_world"]["translation"] = place.tolist()
        for track in content["tracks"]:
            for pose in track["poses"]:
                pose["translation"] = (np.array(pose["translation"]) + far).tolist()

    write_mcap(changed(recorded, tmp_path / "drive", change), tmp_path / "own.mcap")
    write_mcap(recorded, tmp_path / "near.mcap")
    found, near = Recording.of(tmp_path / "own.mcap"), Recording.of(tmp_path / "near.mcap")
    first = near.ego[min(near.messages["/odom"])[0]][:3, 3]
    np.testing.assert_allclose(found.points(CLOUDS, 5), near.points(CLOUDS, 5) - first, atol=1e-3)
    for one, other in zip(found.all(BOXES)[5].detections, near.all(BOXES)[5].detections, strict=True):
        np.testing.assert_allclose(
            pose_of(one.bbox.center)[:3, 3], pose_of(other.bbox.center)[:3, 3] - first, atol=1e-6
        )


def test_a_camera_whose_mount_varies_has_it_at_every_image(recorded, scene, tmp_path):
    def change(content: dict[str, Any]) -> None:
        content["frames"][4]["camera_to_world"]["translation"][2] += 0.01

    write_mcap(changed(recorded, tmp_path / "drive", change), tmp_path / "own.mcap")
    found = Recording.of(tmp_path / "own.mcap")
    assert "CAM_FRONT_optical_frame" not in found.static
    mounts = [
        one
        for message in found.all("/tf")
        for one in message.transforms
        if one.child_frame_id == "CAM_FRONT_optical_frame"
    ]
    assert len(mounts) == len(scene.frames)
    time = nanoseconds(mounts[4].header)
    raised = scene.frames[4].camera_to_world.copy()
    raised[2, 3] += 0.01
    np.testing.assert_allclose(found.ego[time] @ pose_of(mounts[4].transform), raised, atol=1e-6)


def test_without_lidar_or_boxes_their_topics_are_missing(recorded, tmp_path):
    def change(content: dict[str, Any]) -> None:
        content["sweeps"], content["lidars"], content["tracks"] = [], {}, []

    counts = write_mcap(changed(recorded, tmp_path / "drive", change), tmp_path / "own.mcap")
    assert set(counts) == {"/tf_static", "/tf", "/odom", IMAGES, INFO}


def test_lidar_alone_and_names_that_ros_does_not_allow(recorded, scene, tmp_path):
    def change(content: dict[str, Any]) -> None:
        content["frames"], content["cameras"] = [], {}
        content["lidars"] = {"1st top__lidar": content["lidars"]["LIDAR_TOP"]}
        for one in content["sweeps"]:
            one["lidar"] = "1st top__lidar"

    write_mcap(changed(recorded, tmp_path / "drive", change), tmp_path / "own.mcap")
    found = Recording.of(tmp_path / "own.mcap")
    topic = "/sensor_1st_top_lidar/points"
    assert set(found.types) == {"/tf_static", "/tf", "/odom", topic, MARKERS, BOXES}
    returns = apply(scene.sweeps[2].sensor_to_world, read_returns(scene.sweeps[2]).points)
    np.testing.assert_allclose(found.points(topic, 2), returns, atol=1e-4)


def test_images_of_other_kinds_are_encoded_anew(recorded, tmp_path):
    folder = changed(recorded, tmp_path / "drive")
    (folder / "images").unlink()
    content = json.loads((folder / "drive.json").read_text())
    sources = [recorded / one["file"] for one in content["frames"]]
    turned = Image.Exif()
    turned[0x0112] = 6
    for i, (one, source) in enumerate(zip(content["frames"], sources, strict=True)):
        one["file"] = f"images/{i}.{'png' if i else 'jpg'}"
        (folder / "images").mkdir(exist_ok=True)
        image = Image.open(source)
        image.save(folder / one["file"], **({} if i else {"exif": turned, "quality": 100, "subsampling": 0}))
    (folder / "drive.json").write_text(json.dumps(content))
    write_mcap(folder, tmp_path / "own.mcap")
    for source, message in zip(sources, Recording.of(tmp_path / "own.mcap").all(IMAGES), strict=True):
        found = Image.open(BytesIO(message.data.tobytes()))
        assert found.format == "JPEG" and found.getexif().get(0x0112, 1) == 1
        assert np.abs(np.asarray(found).astype(int) - np.asarray(Image.open(source)).astype(int)).mean() < 3.0


# ---- bad input


def no_poses(content: dict[str, Any]) -> None:
    for one in content["frames"]:
        del one["camera_to_world"], one["ego_to_world"]
    for one in content["sweeps"]:
        del one["lidar_to_world"]


def missing_image(content: dict[str, Any]) -> None:
    content["frames"][2]["file"] = "images/CAM_FRONT/none.jpg"


def missing_sweep(content: dict[str, Any]) -> None:
    content["sweeps"][2]["file"] = "sweeps/none.npz"


def other_size(content: dict[str, Any]) -> None:
    content["cameras"]["CAM_FRONT"]["width"] += 2


def wrong_rate(content: dict[str, Any]) -> None:
    content["frames"][1]["timestamp"] = content["frames"][0]["timestamp"]


def late(content: dict[str, Any]) -> None:
    later = 10**15  # 31 years
    for one in (
        *content["frames"],
        *content["sweeps"],
        *(pose for track in content["tracks"] for pose in track["poses"]),
    ):
        one["timestamp"] += later
    content["key_frames"] = [time + later for time in content["key_frames"]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (late, "its times are later than 2038, which ROS cannot state"),
        (no_poses, "there are no poses, without which ROS has no transforms; add ego_poses"),
        (missing_image, r"image .*none\.jpg cannot be read"),
        (missing_sweep, r"none\.npz is missing; restore it, or take it out of drive\.json"),
        (other_size, "is 96x54, but its camera has 98x54"),
        (wrong_rate, "has the same camera and timestamp"),
    ],
)
def test_a_faulty_drive_is_refused_in_one_sentence_and_leaves_nothing(recorded, tmp_path, change, message):
    folder = changed(recorded, tmp_path / "drive", change)
    with pytest.raises(DatasetError, match=message) as refused:
        write_mcap(folder, tmp_path / "out/own.mcap")
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.glob("out/*")) and not list(tmp_path.glob("out/.*"))


def test_scans_beside_a_drive_in_another_world_are_refused(folder, tmp_path):
    """Without an origin the map begins at the first pose of the drive, and the world of the scans at a key frame's."""
    drive = changed(folder / "drive", tmp_path / "drive", lambda content: content.update(origin=None))
    with pytest.raises(DatasetError, match="no origin of its world"):
        write_mcap(drive, tmp_path / "own.mcap", folder / "scans/scans.json")
    assert write_mcap(drive, tmp_path / "own.mcap")[IMAGES]


def test_scans_without_times_or_damaged_are_refused(folder, tmp_path):
    record = json.loads((folder / "scans/scans.json").read_text())
    (tmp_path / "scans.json").write_text(json.dumps(record))
    file = tmp_path / record["scans"][0]["files"]["npz"]
    file.parent.mkdir()
    file.write_bytes(b"PK\x03\x04 not a file")
    with pytest.raises(ResultError, match=r"not a readable scan .* delete scans\.json"):
        write_mcap(folder / "drive", tmp_path / "own.mcap", tmp_path / "scans.json")
    for scan in record["scans"]:
        scan["files"] = {"ply": "a.ply"}
    (tmp_path / "scans.json").write_text(json.dumps(record))
    with pytest.raises(ResultError, match=r"add 'npz' to export\.scan_formats"):
        write_mcap(folder / "drive", tmp_path / "own.mcap", tmp_path / "scans.json")
    with pytest.raises(ResultError, match="not a readable JSON file"):
        write_mcap(folder / "drive", tmp_path / "own.mcap", tmp_path / "none.json")
    assert not (tmp_path / "own.mcap").exists()


def test_a_folder_that_cannot_be_written_is_named(recorded, tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(ResultError, match=r"taken/own\.mcap: cannot be written"):
        write_mcap(recorded, tmp_path / "taken/own.mcap")


def test_without_rosbags_one_sentence_says_how_to_install_it(recorded, tmp_path, monkeypatch):
    ros_messages.ros_types.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(DriveSplatError, match=r"^MCAP files need the package rosbags: pip install 'drivesplat\[ros]'$"):
        write_mcap(recorded, tmp_path / "own.mcap")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_a_file_and_says_what_is_in_it(recorded, tmp_path, capsys):
    assert main(["mcap", str(recorded), "--out", str(tmp_path / "own.mcap")]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{tmp_path / 'own.mcap'}: ") and IMAGES in said and (tmp_path / "own.mcap").is_file()
    assert main(["mcap", str(tmp_path), "--out", str(tmp_path / "none.mcap")]) == 1
    assert "drive.json is missing" in capsys.readouterr().err


def test_speed_of_the_street_is_that_of_its_boxes(recording):
    """The car ahead drives faster than the ego vehicle: their distance in the map grows."""
    at = {time: pose_of(one.bbox.center)[0, 3] for time, message in recording.messages[BOXES]
          for one in message.detections if one.id == AHEAD}  # fmt: skip
    times = sorted(at)
    assert (at[times[-1]] - at[times[0]]) / (1e-9 * (times[-1] - times[0])) == pytest.approx(SPEED, rel=0.01)
