"""cameras.json: a trajectory that leads back to the dataset's tables, and says what it means."""

import dataclasses
import json

import numpy as np
import pytest
from helpers.hand_made import recording_of
from scipy.spatial.transform import Rotation

from drivesplat.export.splat_asset import cameras_record
from drivesplat.io.storage import write_json
from drivesplat.scene.images import project
from drivesplat.scene.rigid import inverse

SHIFT = np.array([0.3039349319818, 0.1, 0.7])


@pytest.fixture(scope="module")
def record(tiny_scene, tmp_path_factory):
    """What a reader finds in the file of a training at half the recorded width, every fourth key frame held out, the
    last two as a block. The origin of the world needs 64 bits."""
    path, origin = tmp_path_factory.mktemp("cameras") / "cameras.json", tiny_scene.origin + SHIFT
    recording = recording_of(tiny_scene, width=48, every_nth=4, offset=2, last_block=2)
    write_json(path, cameras_record(dataclasses.replace(tiny_scene, origin=origin), recording.record))
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


def test_poses_give_the_global_frame_of_the_dataset_and_no_path_of_the_machine_is_recorded(record, tiny_root):
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
            found[:3, 3] += np.array(record["origin"]) - SHIFT
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        assert image["image"] == row["filename"].rsplit("/")[-1]
        assert image["is_key_frame"] == row["is_key_frame"] and image["camera"] == "CAM_FRONT"
    assert str(tiny_root) not in json.dumps(record)


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


def test_every_image_has_its_split_and_key_frame(record, tiny_scene):
    split_of = {image["sample_index"]: image["split"] for image in record["images"] if image["is_key_frame"]}
    held_out = dict.fromkeys((2, 6), "interpolation") | dict.fromkeys((8, 9), "extrapolation")
    assert split_of == dict.fromkeys(range(10), "train") | held_out
    assert {image["split"] for image in record["images"] if not image["is_key_frame"]} <= {"train", "excluded"}
    assert record["key_frame_timestamps"] == tiny_scene.key_frame_timestamps.tolist()
    assert [image["sample_index"] for image in record["images"]] == [f.sample_index for f in tiny_scene.frames]
