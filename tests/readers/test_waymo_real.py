"""A real frame of the Waymo Open Dataset, v1, without LiDAR: test data of waymo-research/waymo-open-dataset
(utils/testdata/pvps_data_one_frame.tfrecord). Its licence keeps it out of this project."""

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf.empty_pb2 import Empty
from google.protobuf.unknown_fields import UnknownFieldSet
from helpers import REPOSITORY, drives
from PIL import Image

from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.waymo.names import CAMERAS
from drivesplat.readers.waymo.reader import read
from drivesplat.readers.waymo.v1 import tfrecords
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import boxes_at

NAME = "1024360143612057520_3580_000_3600_000"
FILE = Path(
    os.environ.get("WAYMO_ONE_FRAME", REPOSITORY.parent / "shared/data/waymo-one-frame/pvps_data_one_frame.tfrecord")
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FILE.is_file(), reason="the real frame is not there: set WAYMO_ONE_FRAME to it"),
]
SOURCE = drives.source(dataset="real", reader="waymo", version="v1", scene=NAME[:19], cameras=tuple(CAMERAS.values()))


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("real")
    shutil.copy(FILE, root / f"segment-{NAME}_with_camera_labels.tfrecord")
    return root


@pytest.fixture(scope="module")
def scene(root) -> Scene:
    return read(root, SOURCE)


def test_five_images_of_two_sizes_lie_22_to_72_ms_after_their_frame(root, tmp_path):
    scene = extract_scene(SOURCE, root, None, tmp_path)
    after = {f.camera: (f.timestamp - scene.key_frame_timestamps[0]) * 1e-3 for f in scene.frames}
    assert {name: round(ms) for name, ms in after.items()} == {
        "FRONT": 52, "FRONT_LEFT": 42, "FRONT_RIGHT": 62, "SIDE_LEFT": 22, "SIDE_RIGHT": 72,
    }  # fmt: skip
    for frame in scene.frames:
        with Image.open(frame.image_path) as image:
            assert image.size == (1920, 886 if "SIDE" in frame.camera else 1280) == (frame.width, frame.height)
    assert {camera.distortion_model for camera in scene.cameras} == {"none"}, "images are undistorted"


def test_cameras_look_where_they_are_mounted(scene):
    headings = {}
    for frame in scene.frames:
        x, y, z = np.linalg.inv(frame.ego_to_world)[:3, :3] @ frame.camera_to_world[:3, 2]
        headings[frame.camera] = round(np.degrees(np.arctan2(y, x)) / 15) * 15
        assert abs(z) < 0.05 and frame.camera_to_world[2, 1] < -0.99, "level and upright"
        assert np.linalg.norm(frame.ego_to_world[:3, 3]) < 1.0, "the origin is subtracted"
    assert headings == {"FRONT": 0, "FRONT_LEFT": 45, "FRONT_RIGHT": -45, "SIDE_LEFT": 90, "SIDE_RIGHT": -90}
    assert np.linalg.norm(scene.origin) > 25_000
    for camera in scene.cameras:
        assert 0.043 < camera.readout_s < 0.045 and camera.readout_direction == "right"
    middles = {frame.camera: round(1e3 * frame.readout_middle_s, 1) for frame in scene.frames}
    assert min(middles.values()) == -4.4 and max(middles.values()) == 3.1, "milliseconds"


def test_the_labels_have_sky_above_and_road_below(root, tmp_path):
    scene = extract_scene(SOURCE.model_copy(update={"cameras": ("FRONT",)}), root, None, tmp_path)
    classes = np.asarray(Image.open(scene.frames[0].classes_path))
    assert classes.shape == (1280, 1920) and scene.sky_class == 25
    sky, road = classes == 25, classes == 20
    assert sky[:200].mean() > 0.5 and not sky[800:].any() and road[900:].mean() > 0.5 and not road[:400].any()


def test_there_are_75_boxes(scene):
    assert Counter(track.category for track in scene.tracks) == {
        "vehicle": 37, "sign": 25, "pedestrian": 12, "cyclist": 1,
    }  # fmt: skip
    assert scene.sweeps == () == scene.lidars


def test_boxes_project_to_the_rectangles_that_waymo_projected(scene):
    """Within 0.3 pixels, in all cameras: `Frame.projected_lidar_labels`, whose pixels count from the image's corner."""
    compared = 0
    for camera, box_id, rectangle in waymos_rectangles():
        frame = next(frame for frame in scene.frames if frame.camera == CAMERAS[camera])
        lens = next(one for one in scene.cameras if one.name == frame.camera)
        box = next(box for box in boxes_at(scene, frame.timestamp) if box_id.startswith(box.track_id))
        to_camera = np.linalg.inv(frame.camera_to_world)
        corners = box.corners @ to_camera[:3, :3].T + to_camera[:3, 3]
        if corners[:, 2].min() < 1.0:
            continue
        pixels, _ = cv2.projectPoints(corners, np.zeros(3), np.zeros(3), lens.intrinsics, lens.distortion)
        low, high = pixels[:, 0].min(axis=0) + 0.5, pixels[:, 0].max(axis=0) + 0.5
        if low.min() > 0 and high[0] < lens.width and high[1] < lens.height:
            np.testing.assert_allclose([*low, *high], rectangle, atol=0.3)
            compared += 1
    assert compared == 45


def waymos_rectangles() -> Iterator[tuple[int, str, list[float]]]:
    """Camera, label's id, and left, top, right, bottom of each label in field 9 of the frame."""
    (message,) = tfrecords(FILE)
    for labels in fields(message, 9):
        (camera,) = fields(labels, 1)
        for label in fields(labels, 2):
            (box,), (name,) = fields(label, 1), fields(label, 4)
            x, y, height, width = np.array([next(fields(box, i)) for i in (1, 2, 4, 5)], "<u8").view("<f8")
            yield camera, name.decode(), [x - width / 2, y - height / 2, x + width / 2, y + height / 2]


def fields(message: bytes, wanted: int) -> Iterator[Any]:
    """The values of a field of a message: numbers, and bytes of messages and texts."""
    for field in UnknownFieldSet(Empty.FromString(message)):
        if field.field_number == wanted:
            yield field.data
