"""cameras.json: a trajectory that leads back to the dataset's tables, and says what it means."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivesplat.export.splat_asset import cameras_record
from drivesplat.io.point_cloud import PointCloud
from drivesplat.io.storage import write_json
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.images import project
from drivesplat.scene.rigid import inverse
from drivesplat.settings.images import HoldoutSettings, ImageSettings, ParserJob

SEED = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), {})


@pytest.fixture(scope="module")
def parser(tiny_scene):
    """Trained at half the recorded width, every fourth key frame held out, the last two as a block."""
    holdout = HoldoutSettings(every_nth=4, offset=2, last_block=2)
    return training_record(tiny_scene, SEED, ParserJob(holdout=holdout, images=ImageSettings(width=48)))


@pytest.fixture(scope="module")
def record(tiny_scene, parser, tmp_path_factory):
    """What a reader finds in the file."""
    path = tmp_path_factory.mktemp("cameras") / "cameras.json"
    write_json(path, cameras_record(tiny_scene, parser))
    return json.loads(path.read_text())


def table(root, name: str) -> dict[str, dict]:
    return {row["token"]: row for row in json.loads((root / "v1.0-mini" / f"{name}.json").read_text())}


def matrix(row: dict) -> np.ndarray:
    """The pose (4, 4) of a row of nuScenes' tables."""
    w, x, y, z = row["rotation"]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = row["translation"]
    return pose


def test_poses_give_the_global_frame_of_the_dataset(record, tiny_root):
    """World plus origin is where the tables' chain of calibration and ego pose puts the camera."""
    ego_poses, sensors = table(tiny_root, "ego_pose"), table(tiny_root, "calibrated_sensor")
    rows = [row for row in table(tiny_root, "sample_data").values() if row["fileformat"] == "jpg"]
    by_time = {row["timestamp"]: row for row in rows}
    assert len(record["images"]) == len(rows) == 19
    for image in record["images"]:
        row = by_time[image["timestamp"]]
        ego_to_global = matrix(ego_poses[row["ego_pose_token"]])
        camera_to_global = ego_to_global @ matrix(sensors[row["calibrated_sensor_token"]])
        for key, expected in (("ego_to_world", ego_to_global), ("camera_to_world", camera_to_global)):
            found = np.array(image[key])
            found[:3, 3] += record["origin"]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        assert image["image"] == row["filename"].rsplit("/")[-1]
        assert image["is_key_frame"] == row["is_key_frame"] and image["camera"] == "CAM_FRONT"


def test_float64_and_microseconds_are_preserved(tiny_scene, parser, tmp_path):
    odd = dataclasses.replace(tiny_scene, origin=np.array([411.3039349319818, 1180.8903791765097, 0.1]))
    write_json(tmp_path / "cameras.json", cameras_record(odd, parser))
    again = json.loads((tmp_path / "cameras.json").read_text())
    assert again["origin"] == odd.origin.tolist()
    assert again["key_frame_timestamps"] == odd.key_frame_timestamps.tolist()
    for image, frame in zip(again["images"], odd.frames, strict=True):
        np.testing.assert_array_equal(image["camera_to_world"], frame.camera_to_world)
        np.testing.assert_array_equal(image["ego_to_world"], frame.ego_to_world)
        assert image["timestamp"] == frame.timestamp and image["sample_index"] == frame.sample_index


def test_intrinsics_belong_to_the_size(record, tiny_scene):
    """A point is projected to the same place, relative to the image's size, as by the recorded intrinsics."""
    for image, frame in zip(record["images"], tiny_scene.frames, strict=True):
        assert (image["width"], image["height"]) == (48, 27)
        points = frame.ego_to_world[:3, 3] + np.array([[12.0, 3.0, 0.5], [20.0, -4.0, 2.0]])
        in_camera = points @ inverse(frame.camera_to_world)[:3, :3].T + inverse(frame.camera_to_world)[:3, 3]
        recorded = in_camera @ frame.intrinsics.T
        expected = (recorded[:, :2] / recorded[:, 2:] + 0.5) * [48 / frame.width, 27 / frame.height]
        found, _ = project(points, inverse(np.array(image["camera_to_world"])), np.array(image["K"]))
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_every_image_has_its_split(record):
    split_of = {image["sample_index"]: image["split"] for image in record["images"] if image["is_key_frame"]}
    assert split_of == {
        **dict.fromkeys(range(10), "train"),
        2: "interpolation",
        6: "interpolation",
        8: "extrapolation",
        9: "extrapolation",
    }
    assert {image["split"] for image in record["images"] if not image["is_key_frame"]} <= {"train", "excluded"}


def test_the_record_contains_no_paths_of_the_machine(record, tiny_root):
    assert str(tiny_root) not in json.dumps(record)
    assert all("/" not in image["image"] for image in record["images"])
