"""Drive folders: written from a scene, read back as the same scene, and checked."""

import copy
import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import REPOSITORY, drives
from helpers.drives import scene_at
from helpers.mutations import damages, mutate_json
from PIL import Image
from plyfile import PlyData, PlyElement

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.drive.__main__ import main
from drivesplat.readers.drive.layout import camera_names, find_root
from drivesplat.readers.drive.reader import chosen_recordings, read
from drivesplat.readers.drive.write import write_drive
from drivesplat.readers.sweeps import read_returns, sweep_fault
from drivesplat.scene.recorded_shutters import shutters
from drivesplat.scene.scene import Scene
from drivesplat.settings.extract import SceneSource

pytestmark = pytest.mark.usefixtures("uncompared")

POINTS = np.array([(5.0, 1.0, 0.5), (9.0, -2.0, 0.1)], dtype=[(name, "f4") for name in "xyz"])


def source(**changes: Any) -> SceneSource:
    return drives.source(**{"dataset": "mine", "reader": "drive", "version": "", "lidar_sweeps": True, **changes})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, tiny_root) -> Scene:
    """The tiny drive by the nuScenes reader, with all recordings between key frames."""
    return scene_at(tiny_root, lidar_sweeps=True)


@pytest.fixture(scope="module")
def folder(recorded, tmp_path_factory) -> Path:
    """The same as a drive folder."""
    root = tmp_path_factory.mktemp("drives")
    write_drive(recorded, root / "0001", licence="of the tests")
    return root


COLUMNS = {
    "frames": ("camera_to_world", "ego_to_world", "intrinsics", "timestamp", "is_key_frame", "sample_index"),
    "sweeps": ("sensor_to_world", "timestamp", "is_key_frame", "sample_index"),
    "tracks": ("id", "object_class", "category", "size", "timestamps", "sample_indices", "object_to_world",
               "visibility"),
}  # fmt: skip


def test_a_written_scene_is_read_back_to_the_last_bit(recorded, folder):
    again = extract_scene(source(), folder)
    assert len(again.frames) > 10 and len(again.sweeps) >= 10
    for name in ("origin", "key_frame_timestamps", "key_frame_hz"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recorded, name))
    for records, columns in COLUMNS.items():
        for one, other in zip(getattr(again, records), getattr(recorded, records), strict=True):
            for name in columns:
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for one, other in zip(again.sweeps, recorded.sweeps, strict=True):
        mine, theirs = read_returns(one), read_returns(other)
        for field in ("points", "intensity", "rings"):
            np.testing.assert_array_equal(getattr(mine, field), getattr(theirs, field))


def test_a_rolling_shutter_is_read_back_with_the_middle_of_its_readout(recorded, tmp_path):
    name = recorded.cameras[0].name
    cameras = tuple(
        dataclasses.replace(camera, readout_s=0.03, readout_direction="down") if camera.name == name else camera
        for camera in recorded.cameras
    )
    frames = tuple(dataclasses.replace(frame, readout_middle_s=0.001 * i) for i, frame in enumerate(recorded.frames))
    scene = dataclasses.replace(recorded, cameras=cameras, frames=frames)
    write_drive(scene, tmp_path / "0001")
    again = extract_scene(source(), tmp_path)
    middles = {frame.token: frame.readout_middle_s for frame in again.frames if frame.camera == name}
    assert len(middles) > 2
    written = {(frame.camera, frame.timestamp): frame.readout_middle_s for frame in frames}
    for frame in again.frames:
        expected = written[frame.camera, frame.timestamp] if frame.camera == name else 0.0
        assert frame.readout_middle_s == expected
    found, expected = (shutters(one) for one in (again, scene))
    for one, other in zip(found, expected, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one.readout_s, other.readout_s)
    record = json.loads((tmp_path / "0001/drive.json").read_text())
    record["frames"][0]["readout_middle_s"] = 3.0
    (tmp_path / "0001/drive.json").write_text(json.dumps(record))
    with pytest.raises(DatasetError, match=r"frames\[0\]\.readout_middle_s is 3\.0"):
        extract_scene(source(), tmp_path)


def test_a_track_that_is_absent_at_one_key_frame_stays_absent(recorded, tmp_path):
    track = max(recorded.tracks, key=lambda track: len(track.timestamps))
    kept = [i for i in range(len(track.timestamps)) if i != 2]
    columns = ("timestamps", "sample_indices", "object_to_world", "visibility")
    broken = dataclasses.replace(track, **{name: getattr(track, name)[kept] for name in columns})
    scene = dataclasses.replace(recorded, tracks=(broken,))
    write_drive(scene, tmp_path / "again")
    with pytest.raises(DatasetError, match="is not empty"):
        write_drive(scene, tmp_path / "again")
    (again,) = read(tmp_path / "again", source()).tracks
    np.testing.assert_array_equal(again.sample_indices, broken.sample_indices)
    np.testing.assert_array_equal(again.object_to_world, broken.object_to_world)


def test_a_frame_range_renumbers_key_frames(recorded, folder):
    again = extract_scene(source(frames=(2, 6), sweeps=False, lidar_sweeps=False), folder)
    np.testing.assert_array_equal(again.key_frame_timestamps, recorded.key_frame_timestamps[2:6])
    assert [frame.sample_index for frame in again.frames] == [0, 1, 2, 3]
    with pytest.raises(DatasetError, match="ends beyond its 10 key frames"):
        extract_scene(source(frames=(2, 60)), folder)


def test_a_folder_is_found_by_itself_and_in_the_one_above(folder):
    assert find_root(str(folder), "") == folder and find_root(str(folder / "0001"), "") == folder / "0001"
    assert camera_names(folder, "") == camera_names(folder / "0001", "") == ["CAM_FRONT"]
    assert len(extract_scene(source(), folder / "0001").frames) > 10
    with pytest.raises(DatasetError, match=r"scene 0002 is not in .*; there are: 0001"):
        extract_scene(source(scene="0002"), folder)
    with pytest.raises(DatasetError, match=r"docs/own_data\.md"):
        find_root(str(folder / "0001/images"), "")


@pytest.fixture(scope="module")
def content(folder) -> dict[str, Any]:
    return json.loads((folder / "0001/drive.json").read_text(encoding="utf-8"))


def test_what_a_person_writes_by_hand(content, folder, tmp_path):
    """Ego poses at 20 Hz as quaternions, no marks, no own poses, boxes at the drive's own times, and PLY sweeps."""
    (tmp_path / "images").symlink_to(folder / "0001/images")
    first = content["frames"][0]
    begin, end = first["timestamp"] - 50_000, content["frames"][-1]["timestamp"] + 50_000
    upright = [1.0, 0.0, 0.0, 0.0]
    poses = [
        {"timestamp": t, "translation": [8.0 * (t - begin) * 1e-6, 100.0, 0.0], "rotation": upright}
        for t in range(begin, end + 50_000, 50_000)
    ]
    boxes = [
        {"timestamp": t, "translation": [20.0, 100.0, 0.7], "rotation": upright} for t in range(begin, end, 500_000)
    ]
    PlyData([PlyElement.describe(POINTS, "vertex")]).write(tmp_path / "one.ply")
    record = {
        "format": "drivesplat drive", "version": 1, "cameras": content["cameras"], "ego_poses": poses,
        "lidars": {"top": {"sensor_to_ego": {"translation": [0, 0, 1.8], "rotation": upright}}},
        "frames": [{key: frame[key] for key in ("camera", "timestamp", "file")} for frame in content["frames"]],
        "sweeps": [{"lidar": "top", "timestamp": first["timestamp"], "file": "one.ply"}],
        "tracks": [{"id": "car", "class": "car", "size": [4.0, 2.0, 1.5], "poses": boxes}],
    }  # fmt: skip
    (tmp_path / "drive.json").write_text(json.dumps(record), encoding="utf-8")
    scene = extract_scene(source(scene=tmp_path.name), tmp_path)
    assert len(scene.key_frame_timestamps) == len(scene.frames) == len(content["frames"])
    np.testing.assert_allclose(scene.origin, [8.0 * 0.05, 100.0, 0.0], atol=1e-12)
    for frame in scene.frames:
        seconds = (frame.timestamp - first["timestamp"]) * 1e-6
        np.testing.assert_allclose(frame.ego_to_world[:3, 3], [8.0 * seconds, 0.0, 0.0], atol=1e-9)
    (sweep,), (track,) = scene.sweeps, scene.tracks
    assert sweep.is_key_frame and sweep_fault(sweep) is None
    np.testing.assert_allclose(read_returns(sweep).points, [(5.0, 1.0, 0.5), (9.0, -2.0, 0.1)], atol=1e-6)
    assert track.category == "car" and set(track.visibility) == {0} and len(track.timestamps) > 5


def test_the_recording_of_a_key_frame_is_the_nearest_within_half_an_interval():
    key_frames, times = np.array([0, 200]), [0, 100, 205, 300]
    for marked, between, expected in (
        ([None] * 4, False, [(0, 0, True), (2, 1, True)]),
        ([None] * 4, True, [(0, 0, True), (1, 0, False), (2, 1, True)]),
        ([True, True, False, False], False, [(0, 0, True), (1, 1, True)]),
    ):
        assert chosen_recordings(times, marked, key_frames, between) == expected
    assert chosen_recordings([350, 400], [None] * 2, key_frames, False) == []
    assert chosen_recordings([], [], key_frames, True) == []


CAMERA, FRAME, TRACK = "cameras.CAM_FRONT", "frames.0", "tracks.0"


def with_value(content: dict[str, Any], place: str, value: Any) -> dict[str, Any]:
    """A copy of a record with another value at a place: `value`, or what it makes of the one that is there."""
    changed = copy.deepcopy(content)
    *way, last = (int(key) if key.isdigit() else key for key in place.split("."))
    holder: Any = changed
    for key in way:
        holder = holder[key]
    holder[last] = value(holder[last]) if callable(value) else value
    return changed


def timed(factor: int, divisor: int = 1):
    return lambda records: [{**one, "timestamp": one["timestamp"] * factor // divisor} for one in records]


FAULTS = {
    "not a drive": ("format", "nuscenes", "format is 'nuscenes'"),
    "another key": ("camera", {}, "camera is no key of the format"),
    "seconds": ("frames", timed(1, 10**6), "timestamps must be microseconds"),
    "nanoseconds of a camera": ("frames", timed(1000), "frames of camera CAM_FRONT span"),
    "milliseconds of sweeps": ("sweeps", timed(1, 1000), "sweeps of lidar LIDAR_TOP are"),
    "a name that no file can have": (f"{FRAME}.file", "a" * 300, "no file can have it"),
    "key frames out of order": (
        "key_frames", lambda times: [*times[2::-1], *times[3:]], "key_frames[2]: its timestamp is not later",
    ),
    "a mirrored camera": (
        f"{CAMERA}.sensor_to_ego.rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]],
        "cameras.CAM_FRONT: its transform mirrors",
    ),
    "K of another image": (
        f"{CAMERA}.K", [[1e-300, 0, 40], [0, 60, 27], [0, 0, 1]],
        "its focal length is 1e-300 pixels; images of 96x54",
    ),
    "coefficients": (
        f"{CAMERA}.distortion", {"model": "fisheye", "coefficients": [0.1]},
        "distortion fisheye has 1 coefficients; it takes 4",
    ),
    "degrees": (
        "lidars.LIDAR_TOP.beam_elevations", [-30.7, -10.0, 10.7],
        "lidars.LIDAR_TOP: its beam_elevations reach 30.7; they are radians",
    ),
    "a lens that folds": (
        f"{CAMERA}.distortion", {"model": "angle_to_radius", "coefficients": [0.62 * 96, 0.0, -200.0]},
        "cameras.CAM_FRONT: its distortion folds",
    ),
    "a polynomial of another lens": (
        f"{CAMERA}.distortion", {"model": "radius_to_angle", "coefficients": [0.3]},
        "cameras.CAM_FRONT: K states a focal length of",
    ),
    "another camera": (f"{FRAME}.camera", "left", "camera 'left' is not in cameras"),
    "a file outside": (f"{FRAME}.file", "../x.jpg", "its file '../x.jpg' must be a path below the dataset's root"),
    "no pose": (
        FRAME, lambda frame: {**frame, "ego_to_world": None, "camera_to_world": None},
        "frames[0]: there are no ego_poses",
    ),
    "two tracks of one id": ("tracks", lambda tracks: [*tracks, tracks[0]], "another track has this id"),
    "a track out of order": (f"{TRACK}.poses", lambda poses: poses[::-1], "not later than that of the one before"),
    "a flat box": (f"{TRACK}.size", [4.0, 0.0, 1.5], "it must be three positive numbers of metres"),
    "an unknown class": (f"{TRACK}.class", "lorry", "tracks[0].class is 'lorry'"),
    "no recordings": ("frames", [], "frames: there is none"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_a_sentence_of_the_checker_and_stops_the_reader(fault, content, tmp_path, capsys):
    place, value, words = FAULTS[fault]
    changed = with_value(content, place, value) | ({"sweeps": []} if fault == "no recordings" else {})
    mine = tmp_path / "0001"
    mine.mkdir()
    (mine / "drive.json").write_text(json.dumps(changed), encoding="utf-8")
    assert main(["check", str(mine)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(words in line for line in lines), lines
    with pytest.raises(DatasetError, match=r"drive\.json"):
        extract_scene(source(), tmp_path)


@damages(25, 200)
def test_mutated_files_end_with_a_sound_scene_or_sentences(content, tmp_path, random):
    """Whatever is accepted is finite, in order, and of the drive's cameras."""
    path = tmp_path / "drive.json"
    path.write_text(json.dumps(mutate_json(random, content)), encoding="utf-8")
    try:
        scene = read(tmp_path, source())
    except DatasetError as error:
        assert str(error).startswith((str(path), "scene 0001")) and len(str(error)) < 5000
        return
    for frame in scene.frames:
        assert np.isfinite(frame.camera_to_world).all() and np.linalg.det(frame.camera_to_world[:3, :3]) > 0.99
        assert frame.camera == "CAM_FRONT" and Path(frame.image_path).is_relative_to(tmp_path)
    assert (np.diff(scene.key_frame_timestamps) > 0).all()
    assert all((track.size > 0).all() and np.isfinite(track.object_to_world).all() for track in scene.tracks)


def test_a_file_that_is_no_record_is_refused_in_a_sentence(tmp_path):
    deep = '{"a": ' + "[" * 200_000
    for text, words in (
        ("", "is not JSON"), ("[1]", "the file is [1]"), (deep, "is not JSON"), ('{"format": NaN}', "format is nan"),
    ):  # fmt: skip
        (tmp_path / "drive.json").write_text(text, encoding="utf-8")
        with pytest.raises(DatasetError) as stopped:
            read(tmp_path, source())
        assert words in str(stopped.value)


def test_the_checker_draws_a_picture_of_a_sound_folder(folder, tmp_path, capsys):
    picture = tmp_path / "check.png"
    assert main(["check", str(folder / "0001"), "--picture", str(picture)]) == 0
    said = capsys.readouterr().out
    assert "10 key frames at 2 Hz" in said and "tracks" in said
    pixels = np.asarray(Image.open(picture))
    assert pixels.shape == (2 * 540, 960, 3), "the sweep of the image's time, and sweeps of other times"
    boxes = (pixels == (255, 90, 0)).all(axis=2)
    assert 100 < boxes.sum() < 20_000


def test_a_sweep_that_cannot_be_is_named(recorded, tmp_path):
    sweep = dataclasses.replace(recorded.sweeps[0], path=str(tmp_path / "sweep.npz"), reader="drive")
    for columns, words in (
        ({"x": [1.0], "y": [2.0]}, "it has no z"),
        ({"x": [1.0], "y": [2.0], "z": [3.0, 4.0]}, "its columns have 1, 2 rows"),
        ({"x": [1e11], "y": [0.0], "z": [0.0]}, "a return is 1e+11 m away"),
        ({"x": [1.0], "y": [0.0], "z": [0.0], "intensity": [200.0]}, "divide them"),
        ({"x": [np.nan], "y": [0.0], "z": [0.0]}, "it has no return with finite coordinates"),
        ({"x": [1001.0], "y": [0.0], "z": [0.0]}, "a return is 1e+03 m away"),
        ({"x": [1.0], "y": [0.0], "z": [0.0], "intensity": [np.nan]}, "intensit"),
        ({"x": [1.0], "y": [0.0], "z": [0.0], "time": [np.inf]}, "time"),
        ({"x": [999.0], "y": [0.0], "z": [0.0]}, ""),
        ({"x": [], "y": [], "z": []}, "is empty"),
        ({"x": ["a"], "y": ["b"], "z": ["c"]}, "no column of numbers"),
    ):
        np.savez(sweep.path, **{name: np.array(values) for name, values in columns.items()})
        assert words in (sweep_fault(sweep) or "")


def test_the_converter_of_the_documentation_writes_a_sound_folder(tmp_path, monkeypatch, capsys):
    page = (REPOSITORY / "docs/own_data.md").read_text(encoding="utf-8")
    (converter,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "drive.json" in code)
    for name in ("front", "top"):
        (tmp_path / "monday" / name).mkdir(parents=True)
    rows = ["timestamp,x,y,z,qw,qx,qy,qz"]
    for i in range(5):
        time = 1_700_000_000_000_000 + 500_000 * i
        Image.new("RGB", (1600, 900), (50 * i, 90, 120)).save(tmp_path / f"monday/front/{time}.jpg")
        PlyData([PlyElement.describe(POINTS, "vertex")]).write(tmp_path / f"monday/top/{time}.ply")
        rows.append(f"{time},{4.0 * i},0.0,0.0,1,0,0,0")
    (tmp_path / "monday/poses.csv").write_text("\n".join(rows))
    monkeypatch.chdir(tmp_path)
    exec(converter, {})
    assert main(["check", "monday"]) == 0
    printed = capsys.readouterr().out
    assert "5 key frames at 2 Hz, 5 images of 1 camera, 5 LiDAR sweeps, no boxes" in printed
    assert re.search(
        r"^methods: vanilla, drifting \(the drive has neither boxes nor LiDAR sweeps with known", printed, re.M
    )
    scene = extract_scene(source(scene="monday", cameras=("front",)), tmp_path / "monday")
    np.testing.assert_allclose(scene.frames[2].camera_to_world[:3, 3], [9.7, 0.0, 1.5], atol=1e-9)
    np.testing.assert_allclose(scene.frames[2].camera_to_world[:3, 2], [1.0, 0.0, 0.0], atol=1e-9), "it looks ahead"


def rewritten(folder: Path, path: Path, content: dict[str, Any]) -> Path:
    """Another record beside the images and sweeps of the drive."""
    path.mkdir()
    for name in ("images", "sweeps"):
        (path / name).symlink_to(folder / "0001" / name)
    (path / "drive.json").write_text(json.dumps(content), encoding="utf-8")
    return path


@pytest.fixture
def lidar_alone(content, folder, tmp_path) -> Path:
    """The drive without cameras and images."""
    less = {key: value for key, value in content.items() if key not in ("cameras", "frames", "key_frames", "origin")}
    return rewritten(folder, tmp_path / "0001", less)


def test_lidar_alone_is_read_checked_and_drawn_from_above(lidar_alone, recorded, capsys):
    """Its key frames are the sweeps, and its world begins at the first one."""
    scene = extract_scene(source(cameras=()), lidar_alone)
    assert scene.frames == scene.cameras == () and [lidar.name for lidar in scene.lidars] == ["LIDAR_TOP"]
    np.testing.assert_array_equal(scene.key_frame_timestamps, [sweep.timestamp for sweep in recorded.sweeps])
    assert all(sweep.is_key_frame for sweep in scene.sweeps) and scene.seconds(scene.sweeps[2].timestamp) > 0
    moved = recorded.sweeps[0].sensor_to_world[:3, 3] - scene.sweeps[0].sensor_to_world[:3, 3]
    for one, other in zip(scene.sweeps, recorded.sweeps, strict=True):
        np.testing.assert_allclose(one.sensor_to_world[:3, 3] + moved, other.sensor_to_world[:3, 3], atol=1e-9)
    assert len(scene.tracks) == len(recorded.tracks)
    assert main(["check", str(lidar_alone)]) == 0
    said = capsys.readouterr().out
    assert "no images: methods that render LiDAR are trained and measured with cameras: []" in said
    pixels = np.asarray(Image.open(lidar_alone / "check.png"))
    assert pixels.shape == (960, 960, 3) and (pixels == (255, 90, 0)).all(axis=2).sum() > 100
    assert (pixels[20:].max(axis=2) > 0).sum() > 1000, "returns"


def test_sensors_that_a_drive_lacks_are_refused_in_a_line(lidar_alone, content, folder, tmp_path):
    with pytest.raises(DatasetError, match=r"scene 0001: it has no image of CAM_FRONT; name cameras that [^\n]*$"):
        extract_scene(source(), lidar_alone)
    assert camera_names(lidar_alone.parent, "") == [], "planning refuses them"
    without = {key: value for key, value in content.items() if key not in ("sweeps", "lidars")}
    images_alone = rewritten(folder, tmp_path / "images_alone", without)
    words = r"scene images_alone: it has no LiDAR sweep, and the settings name no camera[^\n]*$"
    with pytest.raises(DatasetError, match=words):
        extract_scene(source(cameras=(), scene="images_alone"), images_alone)


def test_without_cameras_a_drive_with_images_has_their_key_frames(folder):
    beside_images, with_images = extract_scene(source(cameras=()), folder), extract_scene(source(), folder)
    assert beside_images.frames == beside_images.cameras == ()
    assert [sweep.token for sweep in beside_images.sweeps] == [sweep.token for sweep in with_images.sweeps]
    np.testing.assert_array_equal(beside_images.key_frame_timestamps, with_images.key_frame_timestamps)


@pytest.fixture
def unposed(content, folder, tmp_path) -> Path:
    """The drive without any pose."""
    kept = ("camera", "lidar", "timestamp", "file", "key_frame")
    less = {
        name: [{key: value for key, value in record.items() if key in kept} for record in content[name]]
        for name in ("frames", "sweeps")
    }
    return rewritten(folder, tmp_path / "0001", content | less)


def test_a_drive_without_poses_is_read_where_they_are_estimated(unposed, caplog):
    with pytest.raises(DatasetError, match=r"there are no poses; add ego_poses, or set refine_poses: \{enabled: "):
        read(unposed, source())
    scene = extract_scene(source(poses_from_images=True), unposed)
    assert scene.poses == "none" and len(scene.frames) > 10
    assert all((frame.ego_to_world == np.eye(4)).all() for frame in scene.frames)
    mount = scene.frames[0].camera_to_world
    assert (mount[:3, 3] != 0).any() and all((frame.camera_to_world == mount).all() for frame in scene.frames)
    with pytest.raises(DatasetError, match="scene 0001 has no poses"):
        write_drive(scene, unposed / "again")
    said = " ".join(record.message for record in caplog.records)
    assert "there are no poses; refine_poses estimates them" in said and "hardly moves" not in said


@pytest.mark.parametrize("lacking", ["sweeps", "frames"])
def test_without_poses_a_drive_needs_images_and_lidar(unposed, lacking, capsys):
    path = unposed / "drive.json"
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), lacking: []}), encoding="utf-8")
    assert main(["check", str(unposed)]) == 1
    assert "poses can be estimated only where there are both images and LiDAR sweeps" in capsys.readouterr().out
    with pytest.raises(DatasetError, match="only where there are both"):
        read(unposed, source(poses_from_images=True))
