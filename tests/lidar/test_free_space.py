"""Free space: exact voxel traversal, the protection of surfaces and thin objects, and the record."""

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.drives import CAMERA_AT, HELD_OUT, NOTHING_HELD_OUT, Thing, World, drive, scene_at, seconds_of, true_depths
from helpers.records import write_invalid

from drivesplat.errors import ConfigError, ResultError
from drivesplat.io.array_file import write_arrays
from drivesplat.io.storage import no_provenance
from drivesplat.kernels.sparse_grid import SparseGrid
from drivesplat.lidar.free_space_record import FreeSpace, read_free_space
from drivesplat.lidar.traversal import OCCUPIED, count_passing
from drivesplat.poses.triangulated import TriangulatedPoints
from drivesplat.preprocess.free_space import Rays, camera_rays, free_space_record, lidar_rays, proven_empty, proving
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups, sweep_groups
from drivesplat.settings.free_space import FreeSpaceJob, FreeSpaceSettings

SENSOR = np.array([0.0, 0.0, 1.8])
GOING = Thing("vehicle.car", (4.0, 2.0, 1.6), (9.0, 0.0, 0.8), (6.0, 0.0))
"""A leading car whose distance grows."""


def by(x: float, y: float, z: float) -> np.ndarray:
    """A shift in metres."""
    return np.array([x, y, z])


def settings(**changes: Any) -> FreeSpaceSettings:
    return FreeSpaceSettings(**{"margin": 0.3, "margin_share": 0.0, "min_rays": 1, **changes})


def job(holdout: dict[str, int] = HELD_OUT, radius: float = 2.5, **changes: Any) -> FreeSpaceJob:
    values = {"free_space": settings(**changes), "holdout": holdout, "own_car_radius": radius, "box_margin": 0.2}
    return FreeSpaceJob.model_validate({**values, "free_space": values["free_space"].model_dump()})


def rays_to(ends: np.ndarray, origin: np.ndarray = SENSOR, still: bool = True) -> Rays:
    return Rays(np.broadcast_to(origin, ends.shape), ends, np.full(len(ends), still))


def empty_at(record: FreeSpace, points: Any) -> np.ndarray:
    """Whether world points (n, 3) lie in empty voxels of the record, by its documented key formula."""
    cells = np.floor((np.asarray(points, dtype=float) - record.lower) / record.voxel).astype(int)
    empty = set(record.keys.tolist())
    _, ny, nz = record.shape
    inside = ((cells >= 0) & (cells < record.shape)).all(axis=1)
    return np.array(
        [bool(ok) and int((i * ny + j) * nz + k) in empty for ok, (i, j, k) in zip(inside, cells, strict=True)]
    )


# ---- traversal


def crossed(start: np.ndarray, end: np.ndarray, size: int) -> np.ndarray:
    """The voxels (size, size, size) bool that a segment crosses with positive length, by the slab method per voxel."""
    low = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / (end - start), (low + 1 - start) / (end - start)
    still = end == start
    within = ~still | ((low <= start) & (start < low + 1))
    enter = np.where(still, 0.0, np.minimum(first, second)).max(axis=-1).clip(0.0)
    leave = np.where(still, 1.0, np.maximum(first, second)).min(axis=-1).clip(None, 1.0)
    return (enter < leave) & within.all(axis=-1)


@pytest.mark.parametrize("seed", range(4))
def test_a_ray_is_counted_in_exactly_the_voxels_that_it_passes(seed):
    random, size = np.random.default_rng(seed), 9
    starts, ends = random.uniform(0, size, (40, 3)), random.uniform(0, size, (40, 3))
    ends[:6, random.integers(0, 3)] = starts[:6, 0]
    ends[10:14, :2] = starts[10:14, :2]
    ends[14] = starts[14] + 1e-3
    counts = np.zeros((size,) * 3, np.uint8)
    count_passing(counts, starts, ends)
    expected = sum(crossed(a, b, size).astype(int) for a, b in zip(starts, ends, strict=True))
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_long_ray_ends_in_the_voxel_of_its_end_point(sign):
    """Rays cross 900 voxels at fractions that floats represent inexactly."""
    random = np.random.default_rng(5)
    middle = np.array([450.0, 4.0, 4.0])
    half = np.column_stack([np.full(50, 449.9), random.uniform(-3.9, 3.9, (50, 2))]) * sign
    counts = np.zeros((900, 8, 8), np.uint8)
    count_passing(counts, middle - half, middle + half)
    assert counts[0].sum() == counts[-1].sum() == 50 and (counts.sum(axis=(1, 2)) >= 50).all()


def test_counts_saturate_below_the_value_for_occupied():
    counts = np.zeros((2, 1, 1), np.uint8)
    count_passing(counts, np.full((400, 3), 0.5), np.tile([1.5, 0.5, 0.5], (400, 1)))
    assert counts.ravel().tolist() == [OCCUPIED - 1] * 2


# ---- what rays prove


@pytest.mark.parametrize(
    ("length", "changes", "reach"),
    [
        (10.0, {}, 9.7),
        (10.0, {"margin": 0.0, "margin_share": 0.1}, 9.0),
        (10.0, {"margin": 0.5, "margin_share": 0.1}, 8.5),
        (50.0, {"range": 20.0}, 20.0),
        (0.2, {}, None),
    ],
)
def test_a_ray_proves_nothing_near_its_end_and_beyond_the_range(length, changes, reach):
    direction = np.array([0.6, 0.0, 0.8])
    starts, ends = proving(rays_to((SENSOR + length * direction)[None]), settings(**changes))
    if reach is None:
        assert len(starts) == 0
    else:
        np.testing.assert_allclose(ends[0] - starts[0], reach * direction)


def wall(distance: float = 10.0, half: float = 1.5, step: float = 0.05, height: float = 1.8) -> np.ndarray:
    """Points of a wall before the sensor."""
    y, z = np.meshgrid(np.arange(-half, half, step), height + np.arange(-half, half, step))
    return np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], axis=1)


def test_space_before_a_wall_is_empty_the_wall_and_space_behind_it_are_not():
    record = proven_empty(rays_to(wall()), settings())
    x = np.arange(8.0, 13.0, 0.05)
    empty = empty_at(record, np.column_stack([x, np.zeros(len(x)), np.full(len(x), 1.8)]))
    assert empty[x < 9.0].all() and not empty[x > 9.7].any()


def test_a_dynamic_end_point_does_not_occupy_its_voxel_and_proves_nothing_behind_it():
    place = [[9.9, 0.0, 1.8], [13.0, 0.0, 1.8]]
    gone = rays_to(wall(20.0, half=3.0))
    for still, expected in ((True, [False, True]), (False, [True, True])):
        record = proven_empty(Rays.joined([rays_to(wall(10.0), still=still), gone]), settings())
        assert empty_at(record, place).tolist() == expected
    alone = proven_empty(rays_to(wall(10.0), still=False), settings())
    assert empty_at(alone, place).tolist() == [False, False]


def test_a_voxel_is_empty_only_after_enough_rays_have_passed():
    """Twenty rays per voxel at ten metres, thirty at eight."""
    rays = rays_to(wall(10.0, step=0.3 / np.sqrt(20.0)))
    place = [[9.0, 0.0, 1.8]]
    assert [empty_at(proven_empty(rays, settings(min_rays=n)), place)[0] for n in (1, 15, 60)] == [True, True, False]


def swept(pole: float | None, lost: float = 0.0) -> Rays:
    """Rays of four sensors side by side to a wall behind a pole of radius `pole` (metres, None: no pole) at x = 10, y =
    0. A fraction `lost` of the returns from the pole is missing."""
    found, random = [], np.random.default_rng(0)
    for aside in (-3.0, -1.0, 1.0, 3.0):
        origin, ends = SENSOR + by(0.0, aside, 0.0), wall(16.0, half=4.0, step=0.1)
        if pole is not None:
            along = (ends - origin)[:, :2]
            direction = along / np.linalg.norm(along, axis=1, keepdims=True)
            towards = np.array([10.0, 0.0]) - origin[:2]
            hit = np.abs(direction[:, 0] * towards[1] - direction[:, 1] * towards[0]) < pole
            fraction = (direction @ towards) / np.linalg.norm(along, axis=1)
            ends = np.where(hit[:, None], origin + fraction[:, None] * (ends - origin), ends)
            ends = ends[~hit | (random.random(len(ends)) >= lost)]
        found.append(rays_to(ends, origin))
    return Rays.joined(found)


@pytest.mark.parametrize(("radius", "lost"), [(0.03, 0.0), (0.06, 0.0), (0.15, 0.0), (0.03, 0.9), (0.06, 0.95)])
def test_a_thin_pole_in_voxels_that_most_rays_pass_is_not_empty(radius, lost):
    """Neither is the space around it, even if the pole is so dark that few of its voxels contain a return."""
    heights = np.arange(0.8, 2.8, 0.02)
    pole = np.column_stack([np.full(len(heights), 10.0), np.zeros(len(heights)), heights])
    rays = swept(radius, lost)
    ends = rays.ends[np.abs(rays.ends[:, 0] - 10.0) < 0.5]
    assert 0 < len(ends) < 0.2 * len(rays.ends)
    ended, own = ({tuple(cell) for cell in np.floor(points / 0.3)} for points in (ends, pole))
    assert bool(own - ended) == (lost > 0.0), "a dark pole has voxels without a return"
    assert empty_at(proven_empty(swept(None), settings()), pole).all()
    record = proven_empty(rays, settings())
    for beside in (by(0.0, 0.0, 0.0), by(0.0, 0.3, 0.0), by(-0.3, 0.0, 0.0)):
        assert not empty_at(record, pole + beside).any()
    assert empty_at(record, pole + by(0.0, 0.9, 0.0)).all()


def test_a_road_between_rings_is_not_empty_though_rays_pass_its_voxels():
    """Beams 1.33 degrees apart hit the road 5 to 20 metres ahead in rings up to 5 metres apart, and pass through voxels
    of the road on the last metres before each ring."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-20, 20, 0.33)), np.radians(np.arange(-20.0, -4.0, 1.33)))
    distance = 1.8 / np.tan(-elevation.ravel())
    ends = np.column_stack([distance * np.cos(azimuth.ravel()), distance * np.sin(azimuth.ravel()), 0.0 * distance])
    rays = Rays.joined([rays_to(ends + by(shift, 0.0, 0.0), SENSOR + by(shift, 0.0, 0.0)) for shift in (0.0, 1.1, 2.3)])
    x = np.arange(5.0, 20.0, 0.05)
    on_road, above = (np.column_stack([x, np.zeros(len(x)), np.full(len(x), z)]) for z in (0.02, 1.0))
    grazed = np.zeros(len(x), dtype=bool)
    starts, stops = proving(rays, settings())
    for fraction in np.linspace(0.0, 1.0, 400):
        at = starts + fraction * (stops - starts)
        low = at[(at[:, 2] < 0.3) & (np.abs(at[:, 1]) < 0.3)]
        grazed |= np.isin(np.floor(x / 0.3), np.floor(low[:, 0] / 0.3))
    record = proven_empty(rays, settings())
    assert grazed.mean() > 0.5, "rays must pass the road's voxels"
    assert not empty_at(record, on_road).any()
    assert empty_at(record, above[x < 8.0]).all()


def test_joined_rays_prove_the_same_as_one_set_of_rays():
    """Rays to triangulated points count like LiDAR rays."""
    points = wall()
    ends = np.concatenate([points, points + by(0.0, 0.0, 0.025)])
    several = Rays.joined([rays_to(points), rays_to(points + by(0.0, 0.0, 0.025))])
    for key, value in vars(proven_empty(rays_to(ends), settings())).items():
        np.testing.assert_array_equal(getattr(proven_empty(several, settings()), key), value)


def test_no_rays_prove_nothing():
    assert len(proven_empty(Rays.joined([]), settings()).keys) == 0


def test_a_grid_that_is_too_large_is_refused_with_the_setting_to_change():
    far = rays_to(np.array([[3e4, 0.0, 0.0], [0.0, 3e4, 0.0], [0.0, 0.0, 3e4]]))
    corners = Rays.joined([far, rays_to(far.ends + 5.0, origin=np.array([3e4, 3e4, 3e4]))])
    with pytest.raises(ConfigError, match=r"free_space\.voxel"):
        proven_empty(corners, settings())


# ---- drives


def surfaces(scene: Scene, world: World) -> np.ndarray:
    """World points (n, 3) of surfaces nearer than 40 metres in the images of a drive through the static `world`."""
    found = []
    for frame in scene.frames[::3]:
        depth = true_depths(world, frame)[..., 0]
        rows, columns = np.nonzero(depth < 40.0)
        pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
        rays = pixels @ np.linalg.inv(world.intrinsics).T * depth[rows, columns, None]
        found.append(rays @ frame.camera_to_world[:3, :3].T + frame.camera_to_world[:3, 3])
    return np.concatenate(found)


def test_in_a_drive_air_is_empty_and_surfaces_are_not(tiny_scene):
    record = free_space_record(tiny_scene, job(NOTHING_HELD_OUT))
    still = World(things=[thing for thing in World().things if thing.velocity == (0.0, 0.0)])
    points = surfaces(tiny_scene, still)
    assert len(points) > 10_000 and empty_at(record, points).mean() < 1e-3
    seconds = np.array([seconds_of(frame.timestamp) for frame in tiny_scene.frames[2:-6]])
    path = np.stack([World().ego_at(t) + CAMERA_AT for t in seconds])
    assert empty_at(record, path + by(0.0, 1.5, 0.0)).mean() > 0.9


def test_space_that_a_vehicle_has_left_is_empty(tmp_path):
    """The centre of a car's first position, which the sensor sees empty two seconds later."""
    scene = drive(tmp_path, GOING)
    assert empty_at(free_space_record(scene, job(NOTHING_HELD_OUT)), [[8.0, 0.0, 1.2], [7.4, 0.3, 1.0]]).all()
    without_tracks = dataclasses.replace(scene, tracks=())
    assert not empty_at(free_space_record(without_tracks, job(NOTHING_HELD_OUT)), [[7.1, 0.0, 1.2]]).any()


def test_rays_start_at_the_sensor_of_their_sweep_and_exclude_the_ego_vehicle(tiny_scene):
    rays = lidar_rays(tiny_scene, job())
    starts = {tuple(sweep.sensor_to_world[:3, 3]) for sweep in tiny_scene.sweeps}
    assert len(starts) == 10 and len({tuple(origin) for origin in rays.origins}) == 6
    assert {tuple(origin) for origin in rays.origins} < starts
    assert np.linalg.norm((rays.ends - rays.origins)[:, :2], axis=1).min() > 2.5
    assert 0.0 < (~rays.static).mean() < 0.2


def triangulated(scene: Scene, point: np.ndarray, *seen_by: int) -> TriangulatedPoints:
    """A point (3,) seen by the images `seen_by`."""
    return TriangulatedPoints(point[None], np.array(seen_by), np.zeros(len(seen_by), dtype=np.int64))


def test_training_images_prove_space_before_triangulated_points_empty(tiny_scene):
    """In a scene without LiDAR, for a point seen by two training images, or by a training image and a held-out one."""
    blind = dataclasses.replace(tiny_scene, sweeps=())
    groups = frame_groups(blind, job().holdout)
    seeing, held_out = (
        [i for i, group in enumerate(groups) if (group == "train") is wanted] for wanted in (True, False)
    )
    first = blind.frames[seeing[0]].camera_to_world
    point = first[:3, 3] + 12.0 * first[:3, 2]
    rays = camera_rays(blind, job(), triangulated(blind, point, seeing[0], held_out[0], seeing[1]))
    centres = [blind.frames[i].camera_to_world[:3, 3] for i in seeing[:2]]
    np.testing.assert_allclose(rays.origins, centres)
    np.testing.assert_allclose(rays.ends, [point, point])
    assert rays.static.all()
    assert len(camera_rays(blind, job(), triangulated(blind, point, seeing[0], held_out[0])).ends) == 0
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-1.0, 1.0, 0.1), np.arange(-1.0, 1.0, 0.1)))
    ends = point + np.column_stack([0.0 * y, y, z])
    numbers = np.arange(len(ends))
    many = TriangulatedPoints(ends, np.repeat(seeing[:2], len(ends)), np.concatenate([numbers, numbers]))
    record = free_space_record(blind, job(), many)
    assert empty_at(record, point - 2.0 * first[:3, 2][None]).all() and not empty_at(record, point[None]).any()
    assert len(free_space_record(blind, job()).keys) == 0


def test_held_out_sweeps_prove_nothing(tiny_root, tmp_path):
    root = Path(shutil.copytree(tiny_root, tmp_path / "nuscenes"))
    scene = scene_at(root)
    before = pickle.dumps(free_space_record(scene, job()))
    for sweep, group in zip(scene.sweeps, sweep_groups(scene, job().holdout), strict=True):
        if group != "train":
            np.random.default_rng(0).uniform(-30.0, 30.0, (5000, 5)).astype(np.float32).tofile(sweep.path)
    assert pickle.dumps(free_space_record(scene, job())) == before
    Path(scene.sweeps[0].path).write_bytes(Path(scene.sweeps[2].path).read_bytes())
    assert pickle.dumps(free_space_record(scene, job())) != before, "training sweeps do contribute"


# ---- the record


def test_the_record_survives_a_round_trip(tiny_scene, tmp_path):
    record = dataclasses.replace(free_space_record(tiny_scene, job()), provenance={"stages": {}, "inputs": {"a": "b"}})
    write_arrays(tmp_path / "free_space.npz", record)
    again = read_free_space(tmp_path / "free_space.npz")
    assert (again.voxel, again.provenance) == (record.voxel, record.provenance)
    for name in ("lower", "shape", "keys"):
        assert getattr(again, name).dtype == getattr(record, name).dtype
        np.testing.assert_array_equal(getattr(again, name), getattr(record, name))
    assert len(record.keys) > 1000 and (np.diff(record.keys) > 0).all()


GRID = {
    "lower": np.zeros(3),
    "voxel": 0.3,
    "shape": np.array([9, 9, 9]),
    "keys": np.array([1, 5]),
    "provenance": no_provenance(),
}


@pytest.mark.parametrize(
    "content",
    [None, b"", b"text", [], {}, {key: GRID[key] for key in GRID if key != "keys"},
     *({**GRID, **wrong} for wrong in ({"keys": np.array([5, 1])}, {"keys": [1]}, {"keys": np.ones(2)}, {"voxel": 0.0},
                                       {"lower": np.zeros(2)}))],
    ids=str,
)  # fmt: skip
def test_an_invalid_file_is_refused_with_its_name_and_rule(tmp_path, content):
    path = tmp_path / "free_space.npz"
    write_invalid(path, content)
    with pytest.raises(ResultError, match=r"free_space\.npz: .*the rule 'free_space' rebuilds it"):
        read_free_space(path)
    write_arrays(path, GRID)
    assert read_free_space(path).voxel == 0.3


# ---- lookup


@pytest.mark.parametrize("dimensions", [2, 3])
def test_points_are_found_in_the_cells_that_contain_them(dimensions):
    random = np.random.default_rng(dimensions)
    shape, lower, edge = np.array([7, 4, 5][:dimensions]), np.array([-20.0, 30.0, 1.5][:dimensions]), 0.4
    keys = np.sort(random.choice(shape.prod(), shape.prod() // 3, replace=False))
    points = (lower + random.uniform(-0.5, 1.5, (2000, dimensions)) * shape * edge).astype(np.float32)
    place, found = SparseGrid.from_numpy(lower, edge, shape, keys).lookup(torch.from_numpy(points))
    cells = np.floor((points - lower) / edge).astype(int)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    expected = np.ravel_multi_index(tuple(np.where(inside[:, None], cells, 0).T), tuple(shape))
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(found.numpy(), inside & np.isin(expected, keys))
    np.testing.assert_array_equal(keys[place.numpy()[found.numpy()]], expected[found.numpy()])


def test_an_empty_grid_and_points_that_are_not_finite_have_no_cell():
    points = torch.tensor([[0.1, 0.1], [float("nan"), 0.1], [float("inf"), 0.1]])
    none = SparseGrid.from_numpy(np.zeros(2), 1.0, np.array([1, 1]), np.empty(0, dtype=np.int64))
    one = SparseGrid.from_numpy(np.zeros(2), 1.0, np.array([1, 1]), np.zeros(1, dtype=np.int64))
    assert none.lookup(points)[1].tolist() == [False] * 3
    assert one.lookup(points)[1].tolist() == [True, False, False]
