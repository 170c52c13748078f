"""Images, LiDAR, poses, calibration and boxes of the demo world agree with each other, as the tables state them."""

import numpy as np
import pytest
from helpers.demo_worlds import LIDAR, names_of
from nuscenes.utils.data_classes import Box, LidarPointCloud
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.world.tokens import instance_token

RANGE_NOISE = 0.02


def pose_of(record: dict) -> np.ndarray:
    """The 4x4 matrix of a record of ego_pose, calibrated_sensor or sample_annotation."""
    pose = np.eye(4)
    w, x, y, z = record["rotation"]
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = record["translation"]
    return pose


def sensor_to_global(tables, data: dict) -> np.ndarray:
    ego = pose_of(tables.get("ego_pose", data["ego_pose_token"]))
    return ego @ pose_of(tables.get("calibrated_sensor", data["calibrated_sensor_token"]))


def recording(tables, index: int, channel: str) -> dict:
    return tables.get("sample_data", tables.sample[index]["data"][channel])


def returns(tables, root, index: int) -> np.ndarray:
    """LiDAR returns (n, 3) of a key frame in the sensor's frame."""
    data = recording(tables, index, "LIDAR_TOP")
    return LidarPointCloud.from_file(str(root / data["filename"])).points[:3].T.astype(np.float64)


def png(root, kind: str, index: int) -> np.ndarray:
    return np.asarray(Image.open(root / "truth/CAM_FRONT/recorded" / kind / f"{index:04}.png"))


@pytest.mark.parametrize("index", [0, 5])
def test_lidar_returns_fall_on_pixels_of_the_same_depth(demo_tables, demo_root, index):
    lidar, camera = recording(demo_tables, index, "LIDAR_TOP"), recording(demo_tables, index, "CAM_FRONT")
    to_camera = np.linalg.inv(sensor_to_global(demo_tables, camera)) @ sensor_to_global(demo_tables, lidar)
    points = returns(demo_tables, demo_root, index) @ to_camera[:3, :3].T + to_camera[:3, 3]
    intrinsics = demo_tables.get("calibrated_sensor", camera["calibrated_sensor_token"])["camera_intrinsic"]
    points = points[points[:, 2] > 1.0]
    pixels = points @ np.array(intrinsics).T
    x, y = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    inside = (x >= 0) & (x < 160) & (y >= 0) & (y < 90)
    truth = png(demo_root, "depth", index)[y[inside], x[inside]] / 256.0
    still = png(demo_root, "instances", index)[y[inside], x[inside]] == 0  # movers are elsewhere 35 ms later
    error = np.abs(points[inside, 2] / np.where(truth > 0, truth, np.inf) - 1.0)[still]
    assert len(error) > 1000
    assert np.median(error) < 0.01
    assert (error < 0.05).mean() > 0.85


def test_the_leading_cars_box_holds_the_lidar_returns_that_came_from_it(demo_tables, demo_root, demo_recorder, index=2):
    found = demo_recorder.scan(LIDAR, index * 500_000)
    points, item = demo_recorder.returns(found, LIDAR, index * 500_000), found.object[found.returned]
    np.testing.assert_array_equal(points[:, :3].astype(np.float64), returns(demo_tables, demo_root, index))
    own = points[item == names_of(demo_recorder).index("vehicle 0"), :3].astype(np.float64)
    row = annotation(demo_tables, index, "vehicle 0")
    assert len(own) == row["num_lidar_pts"] > 20
    to_box = np.linalg.inv(pose_of(row)) @ sensor_to_global(demo_tables, recording(demo_tables, index, "LIDAR_TOP"))
    width, length, height = row["size"]
    in_box = own @ to_box[:3, :3].T + to_box[:3, 3]
    assert (np.abs(in_box) < np.array([length, width, height]) / 2 + 5 * RANGE_NOISE).all()
    assert in_box[:, 0].min() < -length / 2 + 0.3, "the ego vehicle sees its rear"
    everything = returns(demo_tables, demo_root, index) @ to_box[:3, :3].T + to_box[:3, 3]
    above_the_road = everything[:, 2] > -height / 2 + 5 * RANGE_NOISE
    held = above_the_road & (np.abs(everything) < np.array([length, width, height]) / 2 + 5 * RANGE_NOISE).all(axis=1)
    assert held.sum() == (in_box[:, 2] > -height / 2 + 5 * RANGE_NOISE).sum(), "nothing else is in it"


def annotation(tables, index: int, name: str) -> dict:
    instance = instance_token("demo", name)
    rows = [tables.get("sample_annotation", t) for t in tables.sample[index]["anns"]]
    return next(row for row in rows if row["instance_token"] == instance)


@pytest.mark.parametrize("index", [0, 5])
def test_objects_that_the_front_camera_shows_within_80_metres_have_a_box(demo_tables, demo_root, demo_recorder, index):
    ego = pose_of(demo_tables.get("ego_pose", recording(demo_tables, index, "LIDAR_TOP")["ego_pose_token"]))
    rows = [demo_tables.get("sample_annotation", t) for t in demo_tables.sample[index]["anns"]]
    boxed = {row["instance_token"] for row in rows}
    shown = np.bincount(png(demo_root, "instances", index).ravel(), minlength=256)
    for number, item in enumerate((t for t in demo_recorder.objects if t.category), start=1):
        distance = np.linalg.norm((demo_recorder.box_to_global(item, index * 0.5) - ego)[:2, 3])
        if distance > 80.0:
            assert instance_token("demo", item.name) not in boxed
        elif shown[number] >= 20:
            assert instance_token("demo", item.name) in boxed


def test_the_devkits_box_in_the_image_surrounds_the_cars_pixels(demo_tables, demo_root, demo_recorder):
    numbers = {item: n for n, item in enumerate((t.name for t in demo_recorder.objects if t.category), start=1)}
    camera = recording(demo_tables, 2, "CAM_FRONT")
    boxes: list[Box] = demo_tables.get_boxes(camera["token"])  # interpolated to the image's time
    at = annotation(demo_tables, 2, "vehicle 0")["translation"]
    box = min(boxes, key=lambda b: np.linalg.norm(b.center - at))
    to_camera = np.linalg.inv(sensor_to_global(demo_tables, camera))
    corners = (to_camera[:3, :3] @ box.corners()).T + to_camera[:3, 3]
    k = np.array(demo_tables.get("calibrated_sensor", camera["calibrated_sensor_token"])["camera_intrinsic"])
    pixels = corners @ k.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    y, x = np.nonzero(png(demo_root, "instances", 2) == numbers["vehicle 0"])
    assert len(x) > 100
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert low[0] - 1 <= x.min() and x.max() <= high[0] + 1 and low[1] - 1 <= y.min() and y.max() <= high[1] + 1
    assert np.ptp(x) + 1 > 0.75 * (high[0] - low[0]) and np.ptp(y) + 1 > 0.75 * (high[1] - low[1])
