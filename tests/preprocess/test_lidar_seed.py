"""Seed points: static LiDAR points and far points, coloured by training images only."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import HELD_OUT, LIDAR_AT, NOTHING_HELD_OUT, START_US, World, cast_lidar, scene_at
from PIL import Image
from plyfile import PlyData, PlyElement

from drivesplat.errors import DatasetError
from drivesplat.io.point_cloud import PointCloud
from drivesplat.lidar.coloring import ColorView, color_by_visibility
from drivesplat.lidar.sweeps import thin
from drivesplat.preprocess import lidar_seed
from drivesplat.preprocess.lidar_seed import color_view, far_points, lidar_points, seed_points, uncovered
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.images import project
from drivesplat.scene.regions import fill, hull_of
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.splits import frame_groups
from drivesplat.scene.tracks import box_at, moving_tracks
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.lidar_seed import LidarSeedSettings, SeedJob


def job(holdout=HELD_OUT, width=None, random_seed=0, **settings) -> SeedJob:
    return SeedJob(
        lidar_seed=LidarSeedSettings(**{"far_points": 200, **settings}),
        holdout=HoldoutSettings(**holdout),
        images=ImageSettings(width=width),
        random_seed=random_seed,
    )


@pytest.fixture(scope="module")
def seed(tiny_scene) -> PointCloud:
    return seed_points(tiny_scene, job())


def returns_at(seconds: float) -> np.ndarray:
    """All LiDAR returns (n, 3) of the tiny drive at a time, in world coordinates, including the ego vehicle's."""
    return cast_lidar(World(), seconds)[:, :3].astype(float) + World().ego_at(seconds) + LIDAR_AT


def within(points: np.ndarray, category: str, seconds: float, margin: float) -> np.ndarray:
    """Which points (n, 3) lie in the thing's box, grown by a margin: things of the tiny drive stand square."""
    (thing,) = [thing for thing in World().things if thing.category == category]
    return (np.abs(points - thing.at(seconds)) < np.array(thing.size) / 2 + margin).all(axis=1)


def rows(points: np.ndarray) -> set[tuple]:
    return {tuple(row) for row in np.round(points, 3)}


def test_lidar_points_are_exactly_the_static_returns_of_training_sweeps(tiny_scene):
    """Ego vehicle, dynamic boxes and held-out sweeps are left out, by the drive's geometry."""
    points, times, missing = lidar_points(tiny_scene, job(voxel_size=0.0))
    assert missing == 0
    for index in range(10):
        seconds = 0.5 * index
        found = points[times == START_US + index * 500_000]
        if index in (2, 6, 8, 9):
            assert len(found) == 0
            continue
        everything = returns_at(seconds)
        kept = np.hypot(*(everything - World().ego_at(seconds) - [0.9, 0.0, 0.0])[:, :2].T) > 2.5
        for dynamic_class in ("vehicle.car", "human.pedestrian.adult"):
            in_box = within(everything, dynamic_class, seconds, 0.2)
            assert in_box.any() or seconds > 2.0, "the case must hold returns from the moving object"
            kept &= ~in_box
        assert within(everything[kept], "vehicle.truck", seconds, 0.05).any()
        assert rows(found) == rows(everything[kept])


def test_held_out_images_and_sweeps_contribute_nothing(tiny_scene, spoilt):
    """Held-out images become magenta and held-out sweeps garbage: not a bit of the seed changes."""
    settings = job(width=64)
    scene = spoilt(settings.holdout, np.random.default_rng(0).uniform(-30.0, 30.0, (500, 5)))
    assert_same_seed(seed_points(scene, settings), seed_points(tiny_scene, settings))


def test_the_ego_vehicle_gives_no_colour(tiny_scene, tmp_path):
    """The ego vehicle fills the left half of every image in red: no seed point is red or lies there."""
    pixels = np.full((54, 96, 3), (0, 0, 255), dtype=np.uint8)
    pixels[:, :49] = (255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "half.png")
    frames = (dataclasses.replace(frame, image_path=str(tmp_path / "half.png")) for frame in tiny_scene.frames)
    scene = dataclasses.replace(tiny_scene, frames=tuple(frames))
    half, red = ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)), {}
    for name, seen in (("whole", {}), ("half", {"CAM_FRONT": (half,)})):
        cloud = seed_points(scene, job(), EgoMask(seen))
        red[name] = int((cloud.colors[:, 0] > 150).sum())
        assert len(cloud.positions) > 200 and cloud.note["far"] > 100
    assert red["whole"] > 100 and red["half"] == 0


def test_a_dynamic_track_leaves_no_points_even_while_it_stands_still(tiny_scene):
    (truck,) = [track for track in tiny_scene.tracks if track.category == "vehicle.truck"]
    poses = truck.object_to_world.copy()
    poses[6:, 0, 3] += 3.0 * np.arange(1, 5)
    later = dataclasses.replace(truck, object_to_world=poses)
    stays, leaves = (dataclasses.replace(tiny_scene, tracks=(track,)) for track in (truck, later))
    assert not box_at(later, START_US, 500_000.0).moves
    assert moving_tracks(leaves) == [later] and moving_tracks(stays) == []
    on_truck = [
        within(points[times == START_US], "vehicle.truck", 0.0, 0.1).sum()
        for points, times, _ in (lidar_points(scene, job(voxel_size=0.0)) for scene in (stays, leaves))
    ]
    assert on_truck[0] > 20 and on_truck[1] == 0


def test_thinning_works_over_the_extent_of_a_long_drive():
    points = np.array([[-2000.0, -2000.0, -50.0], [-2000.0, -2000.0, -49.95], [2000.0, 2000.0, 50.0]])
    assert thin(points, 0.1).tolist() in ([0, 1, 2], [0, 2])
    assert thin(points[[0, 0, 2, 2]], 0.01).tolist() == [0, 2]


K = np.array([[50.0, 0.0, 40.0], [0.0, 50.0, 30.0], [0.0, 0.0, 1.0]])


def view(color, timestamp: int, at=(0.0, 0.0, 0.0), size=(80, 60)) -> ColorView:
    """A camera that looks along world z (x right, y down), all of whose pixels have one colour."""
    pixels = np.broadcast_to(np.array(color, dtype=np.uint8), (size[1], size[0], 3)).copy()
    usable = np.ones((size[1], size[0]), dtype=bool)
    return ColorView(pixels, K, rigid(np.eye(3), -np.array(at, dtype=float)), timestamp, usable)


RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.mark.parametrize("flip", [1, -1])
def test_points_take_the_colour_of_the_view_nearest_in_time(flip):
    moments = np.array([-50.0, 0.0, 40.0, 60.0, 100.0, 900.0])
    points = np.array([[0.2 * i, 0.0, 10.0] for i in range(6)])
    colors, seen = color_by_visibility(points, moments, [view(RED, 0), view(BLUE, 100)][::flip])
    assert [tuple(color) for color in colors] == [RED] * 3 + [BLUE] * 3 and (seen == 2).all()


def test_hidden_points_and_unusable_pixels_give_no_colour():
    """Seen from the left the occluder stands before the point; from the right it stands beside it."""
    left, right = view(RED, 0), view(BLUE, 100, at=(4.0, 0.0, 0.0))
    points = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 5.0]])
    colors, seen = color_by_visibility(points, np.zeros(2), [left, right])
    assert [tuple(color) for color in colors] == [BLUE, RED] and seen.tolist() == [1, 2]
    left.usable[:, :41] = False
    points = np.array([[0.0, 0.0, 10.0], [2.0, 0.0, 10.0]])
    colors, seen = color_by_visibility(points, np.zeros(2), [left, view(BLUE, 100)])
    assert [tuple(color) for color in colors] == [BLUE, RED] and seen.tolist() == [1, 2]


def test_pixels_of_moving_objects_are_not_usable_and_those_of_parked_ones_are(tiny_scene):
    frame = tiny_scene.frames[0]
    source = color_view(tiny_scene, frame, ImageSettings(width=192))
    assert source.pixels.shape == (108, 192, 3)
    for thing in World().things:
        track = next(t for t in tiny_scene.tracks if t.category == thing.category)
        box = box_at(track, frame.timestamp, 500_000.0)
        mask = fill(hull_of(box, inverse(frame.camera_to_world), source.intrinsics), (192, 108))
        assert mask.sum() > 50
        if thing.category in ("vehicle.car", "human.pedestrian.adult"):
            assert not source.usable[mask].any()
        else:
            assert source.usable[mask].any()


def far_view() -> ColorView:
    """A camera 1.5 m above the ground that looks along world x; 60 x 44 pixels, no multiple of a coverage cell."""
    source = view(RED, 0, size=(60, 44))
    pixels = np.random.default_rng(0).integers(0, 256, source.pixels.shape).astype(np.uint8)
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = rigid(forward, np.array([100.0, 20.0, 4.5]))
    return dataclasses.replace(source, pixels=pixels, world_to_camera=inverse(pose))


def some_far_points(count: int, covered: np.ndarray, near: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    candidates = uncovered(far_view(), covered, GROUND)
    return far_points(far_view(), GROUND, candidates, count, (3.0, 300.0), np.random.default_rng(0), near)


def test_far_points_have_distinct_pixels_with_their_colours_and_depths_in_range():
    positions, colors = some_far_points(500, np.empty((0, 3)))
    pixels, depth = project(positions, far_view().world_to_camera, K)
    assert positions.shape == (500, 3)
    columns, rows_ = np.floor(pixels).astype(int).T
    np.testing.assert_allclose(pixels - np.floor(pixels), 0.5, atol=1e-6)
    assert len(set(zip(columns, rows_, strict=True))) == 500
    np.testing.assert_array_equal(colors, far_view().pixels[rows_, columns])
    above = positions[:, 2] > GROUND + 1e-6
    assert (depth[above] >= 3.0 - 1e-9).all() and (depth <= 300.0 + 1e-6).all()


def above(covered: np.ndarray, near: float = 0.0) -> dict[tuple[int, int], np.ndarray]:
    """The depths of far points along all pixels, by cell (x, y), where LiDAR met the points `covered` (n, 3): columns
    and rows in pixels, and depth along the axis."""
    x, y, depth = covered.T
    in_camera = np.stack([(x - 40.0) / 50.0 * depth, (y - 30.0) / 50.0 * depth, depth], axis=1)
    pose = inverse(far_view().world_to_camera)
    positions, _ = some_far_points(60 * 44, in_camera @ pose[:3, :3].T + pose[:3, 3], near)
    pixels, depths = project(positions, far_view().world_to_camera, K)
    cells = np.floor(pixels / 8).astype(int)
    return {tuple(cell): depths[(cells == cell).all(axis=1)] for cell in np.unique(cells, axis=0).tolist()}


GROUND = 3.0


def test_far_points_above_something_upright_have_its_depth():
    """The camera is 1.5 m above the ground: at a depth of 10 m a point in row 28 is 1.9 m high, one in row 36 is 0.3 m
    high. Cells are 8 x 8 pixels."""
    wall, behind_it, low, far_wall = (20.0, 28.0, 10.0), (21.0, 28.5, 60.0), (36.0, 36.0, 10.0), (37.0, 12.0, 40.0)
    depths = above(np.array([wall, behind_it, low, far_wall]))
    for y in range(3):
        np.testing.assert_allclose(depths[2, y], 10.0, err_msg="of the nearest point, in every row above it")
    np.testing.assert_allclose(depths[4, 0], 40.0)
    for cell in ((4, 2), (4, 3), (2, 4), (3, 0)):
        assert np.ptp(np.log(depths[cell])) > 0.5, "neither above the ground, nor below a wall, nor beside it"


@pytest.mark.parametrize("near", [1.0, 0.5])
def test_far_points_may_have_depths_of_what_is_near_in_the_image(near, monkeypatch):
    """The farthest point of the two nearest covered cells counts, of those at most two cells away. Cells are 8 x 8
    pixels."""
    monkeypatch.setattr(lidar_seed, "NEAREST", 2)
    monkeypatch.setattr(lidar_seed, "NEAR_CELLS", 2)
    left, beside, alone = (4.0, 4.0, 9.0), (12.0, 4.0, 5.0), (52.0, 4.0, 30.0)
    depths = above(np.array([left, beside, alone]), near)
    of_cell = {(0, 1): 9.0, (1, 1): 9.0, (6, 1): 30.0, (5, 0): 30.0}
    for cell, expected in of_cell.items():
        close = np.abs(np.log(depths[cell] / expected)) < 5 * lidar_seed.SPREAD
        assert close.all() if near == 1.0 else 0.3 < close.mean() < 0.9
    assert np.ptp(np.log(depths[3, 3])) > 0.5, "too far from all of them"


def assert_same_seed(a: PointCloud, b: PointCloud) -> None:
    np.testing.assert_array_equal(a.positions, b.positions)
    np.testing.assert_array_equal(a.colors, b.colors)
    assert a.note == b.note


def test_the_seed_has_lidar_points_before_far_points_each_seen_by_a_training_image(tiny_scene, seed):
    lidar, far = seed.note["lidar"], seed.note["far"]
    assert lidar > 0 and far == 200 and len(seed.positions) == lidar + far
    assert seed.note["points_file"] == 0 and seed.note["lidar_missing"] == 0 and seed.note["extra_points"] is None
    assert seed.positions.dtype == np.float32 and seed.colors.dtype == np.uint8
    assert np.isfinite(seed.positions).all()
    assert seed.positions[lidar:, 2].min() > -1e-3, "the tiny drive's ground is at z = 0"
    seen = np.zeros(len(seed.positions), dtype=bool)
    for frame, group in zip(tiny_scene.frames, frame_groups(tiny_scene, job().holdout), strict=True):
        if group == "train":
            in_camera = (seed.positions - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3]
            x, y = (0.62 * 96 * in_camera[:, :2] / in_camera[:, 2:]).T
            seen |= (in_camera[:, 2] > 0) & (np.abs(x) <= 48.01) & (np.abs(y) <= 27.01)
    assert seen.all()


def test_the_random_seed_determines_the_seed_points(tiny_scene, seed):
    assert_same_seed(seed_points(tiny_scene, job()), seed)
    assert not np.array_equal(seed_points(tiny_scene, job(random_seed=1)).positions, seed.positions)


def test_memory_of_lidar_points_grows_with_voxels_and_their_points_are_the_same(tiny_scene, monkeypatch):
    """However many sweeps there are: here the same ones 8 times."""
    often = dataclasses.replace(tiny_scene, sweeps=tiny_scene.sweeps * 8)
    settings = job(NOTHING_HELD_OUT, voxel_size=2.0)
    every, every_time, _ = lidar_points(often, settings)
    together = []
    monkeypatch.setattr(lidar_seed, "thin", lambda points, voxel: together.append(len(points)) or thin(points, voxel))
    monkeypatch.setattr(lidar_seed, "THINNED_TOGETHER", 500)
    points, times, _ = lidar_points(often, settings)
    np.testing.assert_array_equal(points, every)
    np.testing.assert_array_equal(times, every_time)
    largest_sweep = max(len(read_returns(sweep).points) for sweep in tiny_scene.sweeps)
    assert len(together) > 5 and max(together) <= len(every) + 500 + largest_sweep


def write_cloud(path: Path, positions: np.ndarray) -> None:
    vertices = np.array([tuple(p) for p in positions], dtype=[(name, "f8") for name in "xyz"])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))


def test_points_of_a_file_are_transformed_from_the_global_frame_and_coloured(tiny_scene, tmp_path):
    """Points on the truck's side, and one that no image sees."""
    (truck,) = [thing for thing in World().things if thing.category == "vehicle.truck"]
    side = np.array(truck.position) + [[dx, truck.size[1] / 2, dz] for dx in (-1.0, 0.0, 1.0) for dz in (-0.5, 0.5)]
    unseen = np.array([[-50.0, 0.0, 1.0]])
    write_cloud(tmp_path / "extra.ply", np.concatenate([side, unseen]) + tiny_scene.origin)
    settings = job(points_file=str(tmp_path / "extra.ply"), far_points=0)
    seed = seed_points(tiny_scene, settings)
    assert (seed.note["points_file"], seed.note["extra_points"]) == (6, "extra.ply")
    np.testing.assert_allclose(seed.positions[-6:], side, atol=1e-4)
    red, _, blue = seed.colors[-6:].astype(int).T
    assert (blue > red + 30).all(), "the truck is the only blue thing below the sky"
    assert seed_points(tiny_scene, job(far_points=0)).note["points_file"] == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda points, origin: points, None),
        (lambda points, origin: points - origin, r"none of 500 points of extra.ply is seen .* \(400.0, 1100.0, 0.0\)"),
        (lambda points, origin: origin + 1000.0 * (points - origin), r"they are [0-9]{4,5} m from the nearest one"),
        (lambda points, origin: np.full_like(points, np.nan), "none of 500 points of extra.ply is seen"),
        (
            lambda points, origin: np.where(np.arange(500)[:, None] % 50 > 0, points - origin, points),
            "1?[0-9] of 500 points of extra.ply (is|are) seen by a training image",
        ),
        (lambda points, origin: points[:0], "extra.ply holds no points"),
    ],
)
def test_points_of_a_file_that_no_image_sees_are_a_warning(tiny_scene, seed, tmp_path, caplog, change, words):
    seen = seed.positions[: seed.note["lidar"]].astype(np.float64) + tiny_scene.origin
    write_cloud(tmp_path / "extra.ply", change(seen[:: len(seen) // 500][:500], tiny_scene.origin))
    seed_points(tiny_scene, job(points_file=str(tmp_path / "extra.ply"), far_points=0))
    said = [record.getMessage() for record in caplog.records if "points_file:" in record.getMessage()]
    assert len(said) == (words is not None) and all(re.search(words, line) for line in said)


def test_an_unreadable_points_file_is_named_with_its_setting(tiny_scene, tmp_path):
    path = tmp_path / "extra.ply"
    for content in (None, b"", b"no PLY", b"ply\nformat ascii 1.0\nelement vertex 1\n"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"lidar_seed\.points_file.*extra\.ply"):
            seed_points(tiny_scene, job(points_file=str(path)))


def test_a_scene_without_lidar_seed_points_or_training_images_is_refused(tiny_scene):
    """Without LiDAR, unless on_missing is warn."""
    scene = dataclasses.replace(tiny_scene, sweeps=())
    for of, settings, words in (
        (scene, job(), r"0001.*lidar_seed\.on_missing: warn"),
        (scene, job(on_missing="warn", far_points=0), r"0001.*no seed points.*far_points"),
        (tiny_scene, job({"last_block": 10}), r"0001.*none of its 10 key frames.*holdout\.last_block"),
    ):
        with pytest.raises(DatasetError, match=words):
            seed_points(of, settings)
    note = seed_points(scene, job(on_missing="warn")).note
    assert (note["lidar"], note["far"]) == (0, 200)


@pytest.mark.slow
def test_the_real_scene_is_seeded_from_its_only_sweep_and_a_file(real_scene_root):
    scene = scene_at(real_scene_root, dataset="nuscenes", scene="0061", sweeps=False)
    with pytest.raises(DatasetError, match=r"LIDAR_TOP.*on_missing"):
        seed_points(scene, job(holdout={}))
    cloud = str(real_scene_root / "sfm_points_global.ply")
    seed = seed_points(scene, job(holdout={}, on_missing="warn", points_file=cloud))
    assert (seed.note["lidar_missing"], seed.note["extra_points"]) == (38, "sfm_points_global.ply")
    assert 1_000 < seed.note["points_file"] <= 2_403
    assert seed.note["lidar"] > 1_000
