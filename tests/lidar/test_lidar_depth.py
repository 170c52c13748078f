"""LiDAR depths of training images, compared with ray-cast depths at each image's own time."""

import dataclasses
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import drives
from helpers.demo_worlds import job_of as world_job_of
from helpers.demo_worlds import world_of
from helpers.drives import (
    CAMERA_AT,
    HELD_OUT,
    LIDAR_AT,
    NOTHING_HELD_OUT,
    Thing,
    World,
    cast_lidar,
    depths_at,
    drive,
    scene_at,
    seconds_of,
    shows,
    true_depths,
)
from helpers.records import write_invalid
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.io.storage import no_provenance
from drivesplat.lidar.depth import split_sweep
from drivesplat.lidar.depth_record import PixelDepths, read_lidar_depth
from drivesplat.lidar.dynamic_objects import DynamicObject, dynamic_objects
from drivesplat.lidar.occlusion import unoccluded
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.readers.truth import read_truth
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups, sweep_groups
from drivesplat.settings.lidar_depth import LidarDepthJob, LidarDepthSettings
from drivesplat.world.generate import make_world

CAR, TRUCK = World().things[:2]
SPEEDING = Thing("vehicle.truck", (4.0, 2.0, 2.6), (9.0, 0.5, 1.3), (1.0, 0.0), gain=(3.0, 0.0))
CROSSING = Thing("vehicle.truck", (4.0, 2.0, 2.6), (24.0, -9.0, 1.3), (0.0, 4.0), heading=np.pi / 2)
"""It crosses the road in front of the ego vehicle from right to left."""


TINY_SPACING = (1.5, 1.65)
"""Degrees between the tiny world's LiDAR rays."""


def job(
    holdout=HELD_OUT, width=None, radius=2.5, margin=0.1, spacing: tuple[float, float] = TINY_SPACING
) -> LidarDepthJob:
    return LidarDepthJob.model_validate(
        {
            "ray_spacing": spacing,
            "holdout": holdout,
            "images": {"width": width},
            "own_car_radius": radius,
            "box_margin": margin,
        }
    )


@pytest.fixture
def root(tiny_root, tmp_path) -> Path:
    """A copy of the tiny drive that a test may damage."""
    return Path(shutil.copytree(tiny_root, tmp_path / "nuscenes"))


def lost(root: Path, *key_frames: int) -> Scene:
    """The tiny drive without the LiDAR files of some key frames."""
    scene = scene_at(root)
    for index in key_frames:
        (root / f"samples/LIDAR_TOP/0001__{index:04}.pcd.bin").unlink()
    return scene


def of(image: PixelDepths, values: np.ndarray) -> np.ndarray:
    """The values (m, ...) of an array (h, w, ...) at an image's pixels."""
    return values[image.rows, image.columns]


def fits(world: World, frame, image: PixelDepths, within: float = 0.02) -> np.ndarray:
    """Whether each depth (m,) lies within the range of depths that its pixel shows at the image's own time."""
    truth = depths_at(world, frame, image.rows, image.columns, subpixels=7)
    return (image.depth > truth.min(axis=1) - within) & (image.depth < truth.max(axis=1) + within)


@pytest.mark.parametrize(
    "things",
    [
        pytest.param(World().things, id="street"),
        pytest.param([CROSSING], id="crossing", marks=pytest.mark.slow),
        pytest.param([SPEEDING], id="speeding", marks=pytest.mark.slow),
    ],
)
def test_depths_match_the_surfaces_visible_at_the_images_own_time(tmp_path, things):
    """Images are taken up to a quarter of a second after the sweep, in which objects move by a metre. LiDAR and camera
    have different positions, so some returns are occluded in the image."""
    world, scene = World(things=things), drive(tmp_path, *things)
    images = lidar_depths(scene, job(NOTHING_HELD_OUT))
    fitting = [fits(world, frame, image) for frame, image in zip(scene.frames, images, strict=True)]
    assert min(map(len, fitting)) > 150, "a return for every thirtieth pixel"
    assert np.concatenate(fitting).mean() > 0.96


@pytest.mark.parametrize(
    "things",
    [pytest.param(World().things, id="street", marks=pytest.mark.slow), pytest.param([CROSSING], id="crossing")],
)
def test_depths_are_at_the_pixels_and_times_of_a_rolling_shutter(tmp_path, things):
    """Against rays cast at the time of each row of a camera that takes 0.4 seconds to read them."""
    world, still = World(things=things), drive(tmp_path, *things)
    readout = {"readout_s": 0.4, "readout_direction": "down"}
    rolling = dataclasses.replace(still, cameras=(dataclasses.replace(still.cameras[0], **readout),))

    def fitting(scene: Scene) -> float:
        fit = []
        for frame, image in zip(scene.frames, lidar_depths(scene, job(NOTHING_HELD_OUT)), strict=True):
            for row in np.unique(image.rows):
                own = image.rows == row
                later = round(0.4e6 * ((row + 0.5) / world.height - 0.5))
                line = dataclasses.replace(frame, timestamp=frame.timestamp + later)
                fit += [fits(world, line, PixelDepths(image.rows[own], image.columns[own], image.depth[own]), 0.03)]
        return float(np.concatenate(fit).mean())

    assert fitting(rolling) > 0.97 and fitting(still) < 0.95


@pytest.mark.parametrize(
    "dynamic_object",
    [pytest.param(CROSSING, id="crossing", marks=pytest.mark.slow), pytest.param(SPEEDING, id="speeding")],
)
def test_depths_of_a_moving_object_match_its_position_in_the_image(tmp_path, dynamic_object):
    """Depths at its pixels are correct to a centimetre, except for returns from the road, also while it accelerates:
    linear interpolation between annotations would err by 9 cm. The first and last second are left out, since a natural
    spline has no acceleration at its ends."""
    world, scene = World(things=[dynamic_object]), drive(tmp_path, dynamic_object)
    images = lidar_depths(scene, job(NOTHING_HELD_OUT))
    fitting = [
        fits(world, frame, image, within=0.01)[of(image, shows(world, frame, dynamic_object))]
        for frame, image in list(zip(scene.frames, images, strict=True))[4:-4]
    ]
    assert min(map(len, fitting)) > 30 and np.concatenate(fitting).mean() > 0.99


def test_a_return_projects_to_the_pixel_and_depth_computed_by_geometry(tiny_scene):
    """A static object, 35 ms before the sweep."""
    image = lidar_depths(tiny_scene, job())[0]
    points = cast_lidar(World(), 0.0)[:, :3].astype(float) + LIDAR_AT
    away = points - World().ego_at(-0.035) - CAMERA_AT
    pixels = np.stack([-away[:, 1], -away[:, 2], away[:, 0]], axis=1) @ World().intrinsics.T
    known = np.column_stack([np.floor(pixels[:, 1::-1] / pixels[:, 2:] + 0.5), away[:, 0]])
    on_truck = of(image, shows(World(), tiny_scene.frames[0], TRUCK))
    found = np.stack([image.rows, image.columns, image.depth], axis=1)[on_truck]
    assert len(found) > 20
    off = np.abs(found[:, None] - known).max(axis=2).min(axis=1)
    assert (off < 1e-3).mean() > 0.9, "except for those on the edge of two pixels"


HEDGE = Thing("movable_object.barrier", (0.5, 8.0, 1.6), (6.0, 0.0, 0.8))
HOUSE = Thing("static_object.bicycle_rack", (2.0, 30.0, 4.0), (25.0, 0.0, 2.0))
"""LiDAR, 30 cm above the camera, sees a part of the house over the hedge that is hidden from the camera."""


def test_returns_over_a_hedge_are_occluded_in_the_image(tmp_path):
    """Rays are at least ten pixels apart: a return from the house may project between two returns from the hedge."""
    size = {"key_frames": 2, "sweeps_between": 0, "width": 480, "height": 270}
    world, scene = World(things=[HEDGE, HOUSE], **size), drive(tmp_path, HEDGE, HOUSE, **size)
    truth, wrong = true_depths(world, scene.frames[0])[..., 0], {}
    for spacing in ((0.0, 0.0), TINY_SPACING):
        image = lidar_depths(scene, job(NOTHING_HELD_OUT, spacing=spacing))[0]
        true = of(image, truth)
        wrong[spacing] = ((true < 10.0) & (image.depth > 20.0)).sum()
    assert wrong[0.0, 0.0] > 50 and wrong[TINY_SPACING] < 0.1 * wrong[0.0, 0.0]
    assert ((true > 20.0) & (np.abs(image.depth - true) < 1.0)).sum() > 70, "the house over the hedge is seen"


@pytest.mark.parametrize(
    ("row", "column", "depth", "seen"),
    [(50, 60, 12.0, False), (45, 60, 12.0, False), (44, 60, 12.0, True), (50, 53, 12.0, False), (50, 52, 12.0, True),
     (50, 60, 10.9, True), (50, 60, 9.0, True), (0, 0, 12.0, True)],
)  # fmt: skip
def test_a_return_occludes_farther_returns_in_its_window(row, column, depth, seen):
    """The window of a return at 10 metres is 15 pixels wide and 11 high around (50, 60); farther: by 5 % and half a
    metre."""
    rows, columns, depths = np.array([50, row]), np.array([60, column]), np.array([10.0, depth])
    halves = np.array([[7.2, 4.8], [0.0, 0.0]])
    assert unoccluded(rows, columns, depths, halves, (100, 100))[1] == seen


def test_an_image_gets_the_training_sweep_nearest_in_time_within_a_key_frames_interval(root):
    """Sweeps 2, 6, 8 and 9 are held out; then 0, 1 and 3 are deleted as well. An image at a key frame is taken 35 ms
    before its sweep and 465 ms after the previous one; the sweep after the next is more than half a second away."""
    scene = scene_at(root)
    whole = lidar_depths(scene, job())
    images = lidar_depths(lost(root, 0, 1, 3), job())
    groups = frame_groups(scene, job().holdout)
    kinds = []
    for frame, group, image, before in zip(scene.frames, groups, images, whole, strict=True):
        away = {sweep: abs(0.5 * sweep - seconds_of(frame.timestamp)) for sweep in (0, 1, 3, 4, 5, 7)}
        near = [sweep for sweep in (4, 5, 7) if away[sweep] < 0.5] if group == "train" else []
        assert (len(image.depth) > 0) == bool(near)
        if near:
            same = all(np.array_equal(value, vars(before)[key]) for key, value in vars(image).items())
            assert same == (min(away, key=away.get) in near)
            kinds.append(same)
    assert kinds.count(True) >= 6 and kinds.count(False) == 1, "at 1.715 s the next sweep stands in for the last"


def test_held_out_sweeps_and_images_contribute_nothing(root):
    scene = lost(root, 1, 7)
    before = lidar_depths(scene, job())
    random = np.random.default_rng(0)
    for frame, group in zip(scene.frames, frame_groups(scene, job().holdout), strict=True):
        if group != "train":
            Image.new("RGB", (96, 54), (255, 0, 255)).save(frame.image_path)
    for sweep, group in zip(scene.sweeps, sweep_groups(scene, job().holdout), strict=True):
        if group != "train":
            random.uniform(-30.0, 30.0, (5000, 5)).astype(np.float32).tofile(sweep.path)
    assert pickle.dumps(lidar_depths(scene_at(root), job())) == pickle.dumps(before)
    Path(scene.sweeps[0].path).write_bytes(Path(scene.sweeps[4].path).read_bytes())
    assert pickle.dumps(lidar_depths(scene_at(root), job())) != pickle.dumps(before), "training sweeps do contribute"


def test_returns_of_an_object_absent_at_the_images_time_are_left_out(root):
    """The car is annotated up to key frame 3 and present until 1.75 s. The image at 1.965 s uses the sweep of 1.5 s,
    since that of its own key frame is deleted; the car's pose is unknown by then."""
    scene = lost(root, 4)
    ending = [
        dataclasses.replace(
            track, timestamps=track.timestamps[:4], sample_indices=track.sample_indices[:4],
            object_to_world=track.object_to_world[:4], visibility=track.visibility[:4],
        )
        if track.category == "vehicle.car" else track
        for track in scene.tracks
    ]  # fmt: skip
    number = next(i for i, frame in enumerate(scene.frames) if frame.is_key_frame and frame.sample_index == 4)
    for tracks, carried in ((scene.tracks, True), (tuple(ending), False)):
        image = lidar_depths(dataclasses.replace(scene, tracks=tracks), job())[number]
        own = of(image, shows(World(), scene.frames[number], CAR))
        on_car = own & fits(World(things=[CAR]), scene.frames[number], image)
        assert (on_car.sum() > 10) == carried


def test_pixels_of_the_ego_vehicles_body_have_no_depth(tiny_scene):
    outline = ((0.0, 0.5), (0.5, 0.5), (0.5, 1.0), (0.0, 1.0))
    whole, cut = (lidar_depths(tiny_scene, job(), EgoMask(seen))[0] for seen in ({}, {"CAM_FRONT": (outline,)}))
    body = [(image.rows >= 27) & (image.columns <= 48) for image in (whole, cut)]
    assert body[0].sum() > 50 and body[1].sum() == 0
    for key, value in vars(whole).items():
        np.testing.assert_array_equal(value[~body[0]], vars(cut)[key])


def moving_car(tiny_scene: Scene) -> DynamicObject:
    (car,) = [item for item in dynamic_objects(tiny_scene) if item.track.category == "vehicle.car"]
    return car


def test_returns_under_a_moving_box_are_neither_dynamic_nor_static(tiny_scene):
    """The car's centre is at x = 8.5 m when its first key frame is taken, 35 ms after the first image; its box is 4 m
    long, 2 m wide, 1.6 m high, and stands on the road."""
    heights = np.array([-0.3, -0.15, 0.0, 0.05, 0.15, 0.8, 1.65, 1.75])
    under = np.stack([np.full(8, 8.5), np.full(8, 0.3), heights], axis=1)
    beside = np.array([[8.5, 1.05, 0.5], [8.5, 1.15, 0.5], [6.45, 0.0, 0.5], [6.35, 0.0, 0.5]])
    cloud = split_sweep(tiny_scene.sweeps[0], np.concatenate([under, beside]), 0.035, [moving_car(tiny_scene)], 0.1)
    np.testing.assert_allclose(cloud.static, [*under[[0, 1, 7]], *beside[[1, 3]]])
    ((_, own),) = cloud.dynamic
    np.testing.assert_allclose(own, np.array([*under[4:7], *beside[[0, 2]]]) - [8.5, 0.0, 0.8], atol=1e-6)


def test_moving_people_are_dynamic_and_parked_vehicles_are_static(tiny_scene):
    assert {item.track.category for item in dynamic_objects(tiny_scene)} == {"vehicle.car", "human.pedestrian.adult"}


@pytest.mark.parametrize(
    "content",
    [None, b"", b"text", [], {}, {"images": []},
     *({"images": images, "provenance": no_provenance()} for images in (None, ["x"], [{"rows": 1}]))],
    ids=str,
)  # fmt: skip
def test_an_invalid_file_is_refused_with_its_name_and_rule(tmp_path, content):
    path = tmp_path / "lidar_depth.npz"
    write_invalid(path, content)
    with pytest.raises(ResultError, match=r"lidar_depth\.npz: .*the rule 'lidar_depth' rebuilds it"):
        read_lidar_depth(path)


def demo_scene(root: Path) -> Scene:
    return drives.scene_at(root, dataset="demo", scene="demo", sweeps=False)


@pytest.fixture(scope="module")
def demo_root(tmp_path_factory) -> Path:
    """A small synthetic drive with its truth: the front camera and LiDAR of the session's drive of that name."""
    root = tmp_path_factory.mktemp("demo")
    make_world(root, world_job_of(world_of(width=160, key_frames=6)), {"stages": {}}, workers=1)
    return root


@pytest.mark.slow
def test_depths_of_the_demo_world_agree_with_its_ground_truth(demo_root):
    """With meshes instead of boxes, 2 cm of noise and LiDAR on the roof, 95 % of all depths are correct to 5 % and 0.3
    m, and nearly all of moving objects."""
    scene = demo_scene(demo_root)
    truth = read_truth(demo_root / "truth/truth.json")
    records = truth.recorded("CAM_FRONT").by_image()
    moving = {item.track.id for item in dynamic_objects(scene)}
    numbers = [int(number) for number, track in truth.instances.items() if track in moving]
    errors, allowed, own = [], [], []
    lidar_job = job(NOTHING_HELD_OUT, margin=0.2, spacing=LidarDepthSettings().ray_spacing)
    for frame, image in zip(scene.frames, lidar_depths(scene, lidar_job), strict=True):
        record = records[frame.token]
        depth, things = (
            np.asarray(Image.open(demo_root / "truth" / name)) for name in (record.depth, record.instances)
        )
        true = of(image, depth) / 256.0
        true[true == 0] = 1e3
        errors.append(np.abs(image.depth - true))
        allowed.append(0.05 * true + 0.3)
        own.append(np.isin(of(image, things), numbers))
    right, of_movers = np.concatenate(errors) < np.concatenate(allowed), np.concatenate(own)
    assert right.mean() > 0.95
    assert of_movers.sum() > 100 and right[of_movers].mean() > 0.98
