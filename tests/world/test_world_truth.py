"""The truth beside the demo world: depth, instances and classes of each key frame, from every viewpoint."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, meshes_at, named, recorder_of
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.readers.truth import Truth, TruthFrame, TruthView, read_truth
from drivesplat.world.layout import CROSSING, LANE
from drivesplat.world.optics.imaging import WorldCamera
from drivesplat.world.optics.raycast import NO_HIT
from drivesplat.world.output.truth import TruthPlan, key_frames_of
from drivesplat.world.recorder import Viewpoint
from drivesplat.world.shapes.mesh import SurfaceClass
from drivesplat.world.tokens import instance_token

KEY_FRAMES, WIDTH, HEIGHT = 6, 160, 90
OFFSETS = {2.0: "left_2m", -2.0: "right_2m", 4.0: "left_4m"}


@pytest.fixture(scope="module")
def truth(demo_root) -> Truth:
    return read_truth(demo_root / "truth/truth.json")


@pytest.fixture(scope="module")
def recorded(truth) -> TruthView:
    found = truth.recorded("CAM_FRONT")
    assert found is not None
    return found


@pytest.fixture(scope="module", params=[0, 5])
def index(request) -> int:
    return request.param


@pytest.fixture(params=OFFSETS)
def lateral(request, truth) -> TruthView:
    return next(view for view in truth.lateral("CAM_FRONT") if view.left_m == request.param)


def png(root, frame: TruthFrame, kind: str) -> np.ndarray:
    return np.asarray(Image.open(root / "truth" / getattr(frame, kind)))


def time_of(index: int) -> int:
    return index * 500_000 - 35_500


def points_of(depth: np.ndarray, camera: WorldCamera) -> np.ndarray:
    """The street coordinates (h, w, 3) of what each pixel's centre shows."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    in_camera = rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    return in_camera @ camera.pose[:3, :3].T + camera.pose[:3, 3]


def test_truth_json_lists_every_view_key_frame_and_file(truth, demo_tables, demo_root):
    assert (truth.scene, truth.width, truth.height, truth.samples_per_pixel) == ("demo", WIDTH, HEIGHT, 1)
    assert truth.leading == instance_token("demo", "vehicle 0") and truth.pattern is None and truth.scans == ()
    views = [(view.camera, view.left_m, view.edit, view.without) for view in truth.views]
    recorded, *lateral = [("CAM_FRONT", left, None, None) for left in (0.0, *OFFSETS)]
    assert views == [recorded, *lateral, (*recorded[:3], truth.leading)]
    images, names = [demo_tables.sample[i]["data"]["CAM_FRONT"] for i in range(KEY_FRAMES)], {}
    for view in truth.views:
        assert [frame.token for frame in view.frames] == images
        assert [frame.key_frame for frame in view.frames] == list(range(KEY_FRAMES))
        for kind in ("image", "depth", "instances", "classes"):
            names |= {getattr(frame, kind): kind for frame in view.frames}
    folder = demo_root / "truth"
    assert names.keys() - {None} == {str(path.relative_to(folder)) for path in folder.rglob("*.png")}
    for name in names.keys() - {None}:
        with Image.open(folder / name) as image:
            mode = {"image": "RGB", "depth": "I;16"}.get(names[name], "L")
            assert (image.size, image.mode) == ((WIDTH, HEIGHT), mode), name


def test_depth_instances_and_classes_are_those_of_what_each_pixel_shows(
    truth, recorded, demo_root, demo_recorder, index
):
    found, frame = demo_recorder.geometry(FRONT, time_of(index)), recorded.frames[index]
    classes, instances = png(demo_root, frame, "classes"), png(demo_root, frame, "instances")
    assert truth.classes == {str(int(c)): c.name.lower() for c in SurfaceClass}
    words = {"vehicle.bicycle": "cyclist", "vehicle": "vehicle", "human": "person", "animal": "animal",
             "movable_object": "object"}  # fmt: skip
    numbers = {name: int(n) for n, name in truth.instances.items()}
    for n, item in enumerate(demo_recorder.objects):
        number = numbers.get(instance_token("demo", item.name), 0)
        assert (number > 0) == (item.category is not None)
        if number:
            own = instances == number
            np.testing.assert_array_equal(own, found.objects == n)
            word = words.get(item.category) or words[item.category.split(".")[0]]
            assert {truth.classes[str(c)] for c in np.unique(classes[own])} <= {word}, item.category
    scenery = {truth.classes[str(c)] for c in np.unique(classes[instances == 0])}
    assert {"road", "sidewalk", "building", "sky"} <= scenery
    assert not scenery & {"vehicle", "person", "cyclist", "animal"}
    decoded, sky = png(demo_root, frame, "depth") / 256.0, found.objects == NO_HIT
    assert (decoded[sky] == 0).all() and 0.02 < sky.mean() < 0.9
    near = ~sky & (found.depth < 255.0)
    assert np.abs(decoded[near] - found.depth[near]).max() <= 0.5 / 256 + 1e-6
    assert (decoded[~sky & (found.depth > 256.0)] == 65535 / 256).all()
    heights = points_of(decoded, demo_recorder.camera(FRONT, time_of(index) * 1e-6))[-10:, :, 2]
    assert np.abs(np.median(heights)) < 0.02, "the lower rows show the road"


def test_markings_are_the_paint_on_the_road(recorded, demo_root, demo_recorder):
    """On the straight road of the demo: lane edges, dashes along the centre line, and the crossing."""
    road, paint = (np.zeros((0, 2)) for _ in range(2))
    for index, frame in enumerate(recorded.frames):
        classes, decoded = png(demo_root, frame, "classes"), png(demo_root, frame, "depth") / 256.0
        places = points_of(decoded, demo_recorder.camera(FRONT, time_of(index) * 1e-6))[..., :2]
        near = decoded < 30.0
        road = np.concatenate([road, places[near & (classes == SurfaceClass.ROAD)]])
        paint = np.concatenate([paint, places[near & (classes == SurfaceClass.MARKING)]])
    assert len(paint) > 200 and len(road) > 5000

    def off(places: np.ndarray, grown: float) -> np.ndarray:
        """Whether places are outside of all paint that is larger by so much on every side."""
        s, t = places[:, 0], np.abs(places[:, 1])
        edge = np.abs(t - LANE) < 0.08 + grown
        dash = (t < 0.08 + grown) & ((s + grown) % 6.0 < 3.0 + 2.0 * grown)
        return ~(edge | dash | ((s > CROSSING[0] - grown) & (s < CROSSING[1] + grown)))

    assert off(paint, 0.06).mean() < 0.01, "depths are rounded, so places are off by centimetres"
    assert off(road, -0.06)[~((road[:, 0] > CROSSING[0]) & (road[:, 0] < CROSSING[1]))].mean() > 0.99


def ego_to_global(tables, sample_data: str) -> np.ndarray:
    pose = tables.get("ego_pose", tables.get("sample_data", sample_data)["ego_pose_token"])
    matrix = np.eye(4)
    w, x, y, z = pose["rotation"]
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), pose["translation"]
    return matrix


def test_lateral_cameras_lie_to_the_left_and_turn_nowhere(lateral, recorded, demo_tables):
    for frame, here in zip(lateral.frames, recorded.frames, strict=True):
        left = ego_to_global(demo_tables, here.token)[:3, 1]
        before, after = (np.array(f.camera_to_global) for f in (here, frame))
        np.testing.assert_allclose(after[:3, 3] - before[:3, 3], lateral.left_m * left, atol=1e-9)
        np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-12)


def test_lateral_images_depths_and_instances_are_those_of_their_stated_pose(
    lateral, recorded, demo_root, demo_recorder, index=3
):
    """What the recorded view sees lies at the same place of the street in the lateral view of the same time."""
    frame, here = lateral.frames[index], recorded.frames[index]
    camera = demo_recorder.camera(FRONT, time_of(index) * 1e-6)
    decoded = png(demo_root, here, "depth") / 256.0
    near = (decoded > 0) & (decoded < 100)
    to_stated = np.linalg.inv(np.array(frame.camera_to_global)) @ np.array(here.camera_to_global)
    to_stated = to_stated @ np.linalg.inv(camera.pose)
    local = points_of(decoded, camera)[near] @ to_stated[:3, :3].T + to_stated[:3, 3]
    pixels, depth = local @ camera.intrinsics.T, local[:, 2]
    x, y = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    inside = (depth > 0) & (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    there = png(demo_root, frame, "depth")[y[inside], x[inside]] / 256.0
    error = np.abs(depth[inside] / np.where(there > 0, there, np.inf) - 1.0)
    same = error < 0.05
    assert inside.sum() > 2500
    assert np.median(error) < 0.01 and same.mean() > 0.5, "a near object hides the rest"
    for kind, share in (("instances", 0.97), ("classes", 0.93)):
        before, after = png(demo_root, here, kind), png(demo_root, frame, kind)
        assert (before[near][inside] == after[y[inside], x[inside]])[same].mean() > share, kind
        assert (before != after).mean() > 0.02, "the view is another one"
    found, view = png(demo_root, frame, "image"), Viewpoint(left=lateral.left_m)
    expected = demo_recorder.to_bytes(demo_recorder.picture(FRONT, time_of(index), view).radiance, FRONT, 0)
    np.testing.assert_array_equal(found, expected)
    assert (found != demo_recorder.image(FRONT, time_of(index))).any(axis=2).mean() > 0.3


def test_the_view_without_the_leading_vehicle_shows_all_others(truth, recorded, demo_root, index):
    number = next(int(n) for n, token in truth.instances.items() if token == truth.leading)
    frame, here = truth.without_leading("CAM_FRONT").frames[index], recorded.frames[index]
    before, after = (png(demo_root, f, "instances") for f in (here, frame))
    own = before == number
    assert own.sum() > 100 and not (after == number).any()
    np.testing.assert_array_equal(before[~own], after[~own])
    depths = [png(demo_root, f, "depth").astype(float) for f in (here, frame)]
    np.testing.assert_array_equal(depths[0][~own], depths[1][~own])
    behind = np.where(depths[1] == 0, np.inf, depths[1])
    assert (behind[own] >= depths[0][own]).all()


@pytest.mark.slow
def test_key_frames_at_which_the_camera_would_be_inside_an_object_are_left_out():
    """4 m to the left is the lane of the oncoming vehicle, which passes the ego vehicle after five seconds."""
    recorder = recorder_of(key_frame_hz=10, image_hz=10, key_frames=80, pedestrians=0, parked=0)
    aside, oncoming = Viewpoint(left=4.0), named(recorder, "vehicle 1")
    kept = key_frames_of(recorder, TruthPlan(FRONT, aside, ""))
    inside, near = [], []
    for index in range(80):
        seconds = index * 0.1 - 0.0355
        pose = recorder.ego_pose(seconds)
        center = (pose @ FRONT.sensor_to_ego)[:3, 3] + 4.0 * pose[:3, 1]
        corners = meshes_at(oncoming, seconds).reshape(-1, 3)  # it drives along x, so its box is upright
        beyond = np.maximum(corners.min(axis=0) - center, center - corners.max(axis=0)).max()
        inside += [index] if beyond < 0.0 else []
        near += [index] if beyond < 0.25 else []
    assert near and not set(kept) & {*inside, *near}
    assert len(kept) >= 80 - len(near) - 2, "no others but those"
    assert key_frames_of(recorder, TruthPlan(FRONT, Viewpoint(), "")) == list(range(80))
    assert key_frames_of(recorder, TruthPlan(FRONT, Viewpoint(without="vehicle 1", left=4.0), "")) == list(range(80))
