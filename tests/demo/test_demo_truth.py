"""The truth beside the demo world: the view from the left, the street without the leading car, depth, instances."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from drivesplat.demo.imaging import DemoCamera, depth_and_objects, render, to_bytes
from drivesplat.demo.raycast import StreetSnapshot
from drivesplat.demo.rig import SENSORS
from drivesplat.demo.tables import token

FRONT = next(sensor for sensor in SENSORS if sensor.channel == "CAM_FRONT")
KEY_FRAMES, WIDTH, HEIGHT = 6, 160, 90
KINDS = ("lateral", "without_leading", "depth", "instances")


@pytest.fixture(scope="module")
def record(demo_root) -> dict:
    return json.loads((demo_root / "truth" / "truth.json").read_text())


@pytest.fixture(scope="module", params=[0, 3, 5])
def index(request) -> int:
    return request.param


def png(root, record: dict, index: int, kind: str) -> np.ndarray:
    return np.asarray(Image.open(root / "truth" / record["frames"][index][kind]))


def seconds_of(index: int) -> float:
    return (index * 500_000 - 35_500) * 1e-6


def view(recorder, index: int) -> tuple[StreetSnapshot, DemoCamera]:
    """The street and the front camera at a key frame."""
    seconds = seconds_of(index)
    return recorder.snapshot(seconds), recorder.camera(FRONT, seconds)


def points_of(depth: np.ndarray, camera: DemoCamera) -> np.ndarray:
    """The street coordinates (h, w, 3) of what each pixel's centre shows."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    in_camera = rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    return in_camera @ camera.camera_to_street[:3, :3].T + camera.camera_to_street[:3, 3]


def test_truth_json_lists_every_key_frame_of_the_front_camera(record, demo_tables):
    assert (record["schema"], record["scene"], record["camera"]) == (1, "demo", "CAM_FRONT")
    assert (record["width"], record["height"], record["samples_per_pixel"]) == (WIDTH, HEIGHT, 1)
    images = [demo_tables.sample[i]["data"]["CAM_FRONT"] for i in range(KEY_FRAMES)]
    assert [frame["sample_data"] for frame in record["frames"]] == images
    assert [frame["sample_index"] for frame in record["frames"]] == list(range(KEY_FRAMES))
    assert record["leading"] == token("demo", "instance", "vehicle 0")


@pytest.mark.parametrize("kind", KINDS)
def test_every_file_of_truth_json_is_there_in_the_images_size(record, demo_root, kind):
    names = [frame[kind] for frame in record["frames"]]
    assert sorted(names) == sorted(str(p.relative_to(demo_root / "truth")) for p in demo_root.glob(f"truth/{kind}/*"))
    mode = {"depth": "I;16", "instances": "L"}.get(kind, "RGB")
    for name in names:
        with Image.open(demo_root / "truth" / name) as image:
            assert (image.size, image.mode) == ((WIDTH, HEIGHT), mode)


def test_instances_list_the_annotated_objects(record, demo_root, demo_recorder, demo_tables):
    assert {instance["token"] for instance in demo_tables.instance} <= set(record["instances"].values())
    shown = set()
    for index in range(KEY_FRAMES):
        shown |= set(np.unique(png(demo_root, record, index, "instances")).tolist())
    assert 0 in shown and len(shown) >= 6
    assert {str(n) for n in shown - {0}} <= record["instances"].keys()


def test_instance_pixels_show_the_listed_object(record, demo_root, demo_recorder, index):
    _, objects = depth_and_objects(*view(demo_recorder, index))
    shown = png(demo_root, record, index, "instances")
    numbers = {name: int(n) for n, name in record["instances"].items()}
    for n, item in enumerate(demo_recorder.objects):
        number = numbers.get(token("demo", "instance", item.name), 0)
        assert (number > 0) == (item.category is not None)
        if number:
            np.testing.assert_array_equal(shown == number, objects == n)


def test_the_depth_image_decodes_to_metres(record, demo_root, demo_recorder, index):
    depth, objects = depth_and_objects(*view(demo_recorder, index))
    decoded = png(demo_root, record, index, "depth") / 256.0
    sky = objects < 0
    assert (decoded[sky] == 0).all() and 0.02 < sky.mean() < 0.9
    near = ~sky & (depth < 255.0)
    assert np.abs(decoded[near] - depth[near]).max() <= 0.5 / 256 + 1e-6
    assert (decoded[~sky & (depth > 256.0)] == 65535 / 256).all()
    heights = points_of(decoded, demo_recorder.camera(FRONT, seconds_of(index)))[-10:, :, 2]
    assert np.abs(np.median(heights)) < 0.02, "the lower rows show the road"


def sunlit_without(points: np.ndarray, sun: np.ndarray, item, seconds: float) -> np.ndarray:
    """Which points (n, 3) have the box of `item`, a little larger, between them and the sun."""
    to_object = np.linalg.inv(item.path.pose_at(seconds))
    start, ray = points @ to_object[:3, :3].T + to_object[:3, 3], to_object[:3, :3] @ sun
    length, width, height = item.mesh.size
    low, high = np.array([-length / 2, -width / 2, 0.0]) - 0.05, np.array([length / 2, width / 2, height]) + 0.05
    with np.errstate(divide="ignore"):
        a, b = (low - start) / ray, (high - start) / ray
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return (enter < leave) & (leave > 0)


@pytest.fixture(scope="module")
def removal(record, demo_root, demo_recorder, index):
    """Image and image without the leading car (both lossless), its pixels, and those it may shade."""
    seconds = seconds_of(index)
    image = demo_recorder.image(FRONT, index * 500_000 - 35_500)
    without = png(demo_root, record, index, "without_leading")
    number = next(int(n) for n, name in record["instances"].items() if name == record["leading"])
    own = png(demo_root, record, index, "instances") == number
    camera = demo_recorder.camera(FRONT, seconds)
    depth, objects = depth_and_objects(demo_recorder.snapshot(seconds), camera)
    leading = next(t for t in demo_recorder.objects if t.name == "vehicle 0")
    shaded = sunlit_without(
        points_of(depth, camera).reshape(-1, 3), demo_recorder.light(seconds).sun_direction, leading, seconds
    )
    return image, without, own, shaded.reshape(own.shape) & (objects >= 0) & ~own


def test_without_the_leading_car_only_its_pixels_and_its_shadow_change(removal):
    image, without, own, shaded = removal
    changed = (image != without).any(axis=2)
    assert changed.any()
    assert not (changed & ~own & ~shaded).any()


def test_the_pixels_of_the_leading_car_change(removal):
    image, without, own, _ = removal
    assert own.sum() > 100
    assert (image != without).any(axis=2)[own].mean() > 0.9


def test_the_leading_cars_shadow_on_the_road_is_gone(removal):
    image, without, own, _ = removal
    change = without.astype(int) - image
    beside = (change != 0).any(axis=2) & ~own
    assert beside.sum() >= 5
    assert (change[beside] >= 0).all() and change[beside].mean() > 10
    rows, columns = np.nonzero(own)
    at = np.argwhere(beside)
    assert (at[:, 0] > rows.mean()).all(), "it lies on the road, below the car's middle"
    assert (np.abs(at[:, 1] - columns.mean()) < 2 * np.ptp(columns)).all()


def test_the_leading_car_leaves_no_trace_on_the_road_below_it(removal):
    """What the car hid is road in the sun: as light as the road beside it."""
    _, without, own, _ = removal
    lower = own & (np.arange(HEIGHT)[:, None] > np.nonzero(own)[0].mean())
    around = binary_dilation(lower, iterations=6) & ~binary_dilation(own, iterations=2)
    assert without[lower].mean() > 0.6 * without[around].mean()


def ego_to_global(tables, sample_data: str) -> np.ndarray:
    pose = tables.get("ego_pose", tables.get("sample_data", sample_data)["ego_pose_token"])
    matrix = np.eye(4)
    w, x, y, z = pose["rotation"]
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), pose["translation"]
    return matrix


def test_camera_poses_agree_with_the_tables_and_lateral_ones_lie_two_metres_left(record, demo_tables):
    for frame in record["frames"]:
        ego = ego_to_global(demo_tables, frame["sample_data"])
        here, there = np.array(frame["camera_to_global"]), np.array(frame["lateral_camera_to_global"])
        in_ego = np.linalg.inv(ego) @ here
        np.testing.assert_allclose(in_ego[:3, 3], [1.701, 0.016, 1.511], atol=1e-6)
        assert in_ego[0, 2] > 0.999, "the camera looks ahead"
        np.testing.assert_allclose(there[:3, 3] - here[:3, 3], 2.0 * ego[:3, 1], atol=1e-9)
        np.testing.assert_allclose(there[:3, :3], here[:3, :3], atol=1e-12)


def lateral_camera(record, demo_recorder, index: int) -> DemoCamera:
    """The camera that truth.json states, brought to the street by the known ego pose."""
    frame = record["frames"][index]
    camera = demo_recorder.camera(FRONT, seconds_of(index))
    to_street = camera.camera_to_street @ np.linalg.inv(frame["camera_to_global"])
    pose = to_street @ np.array(frame["lateral_camera_to_global"])
    return DemoCamera(camera.intrinsics, pose, WIDTH, HEIGHT)


def test_the_lateral_view_agrees_with_its_stated_pose(record, demo_root, demo_recorder, index):
    seconds = seconds_of(index)
    camera = lateral_camera(record, demo_recorder, index)
    expected = to_bytes(render(demo_recorder.snapshot(seconds), demo_recorder.light(seconds), camera, 1))
    found = png(demo_root, record, index, "lateral")
    assert (np.abs(found.astype(int) - expected) <= 2).all(axis=2).mean() > 0.99
    assert (found != demo_recorder.image(FRONT, index * 500_000 - 35_500)).any(axis=2).mean() > 0.3


def test_depth_and_lateral_view_agree_by_reprojection(record, demo_root, demo_recorder, index):
    camera, lateral = demo_recorder.camera(FRONT, seconds_of(index)), lateral_camera(record, demo_recorder, index)
    decoded = png(demo_root, record, index, "depth") / 256.0
    points = points_of(decoded, camera)[(decoded > 0) & (decoded < 100)]
    to_lateral = np.linalg.inv(lateral.camera_to_street)
    in_lateral = points @ to_lateral[:3, :3].T + to_lateral[:3, 3]
    pixels = in_lateral @ lateral.intrinsics.T
    x, y = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    there = depth_and_objects(demo_recorder.snapshot(seconds_of(index)), lateral)[0][y[inside], x[inside]]
    error = np.abs(in_lateral[inside, 2] / there - 1.0)
    assert inside.sum() > 3000
    assert np.median(error) < 0.01 and (error < 0.05).mean() > 0.8
