"""triangulated.npz: which points become seeds, and where their colours come from."""

import dataclasses
import shutil

import numpy as np
import pytest
from helpers.drives import CAMERA_AT, HELD_OUT, TRAINING, World, cast, scene_at
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.io.array_file import write_arrays
from drivesplat.preprocess import lidar_seed
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.poses.triangulated import (
    MAX_MEAN_ERROR,
    Observations,
    TriangulatedPoints,
    no_points,
    read_triangulated,
    triangulated_points,
)
from drivesplat.scene.scene import Scene
from drivesplat.settings.lidar_seed import SeedJob


def job(holdout=HELD_OUT, **settings) -> SeedJob:
    few = {"far_points": 0, "voxel_size": 10.0, **settings}
    values = {"lidar_seed": few, "holdout": holdout, "images": {"width": None}, "random_seed": 0}
    return SeedJob.model_validate(values)


def record_of(points: np.ndarray, seen_by: list[list[int]]) -> TriangulatedPoints:
    """Points (p, 3) and which frames of the scene see each."""
    return TriangulatedPoints(
        points=np.asarray(points, dtype=float),
        seen_by=np.array([frame for frames in seen_by for frame in frames], dtype=np.int64),
        seen_point=np.repeat(np.arange(len(points)), [len(frames) for frames in seen_by]),
    )


def key_frame(scene: Scene, index: int) -> int:
    """Which of the scene's frames is that key frame."""
    return next(i for i, frame in enumerate(scene.frames) if frame.is_key_frame and frame.sample_index == index)


def frames_of(scene: Scene, *indices: int) -> list[int]:
    return [key_frame(scene, index) for index in indices]


def wall(*along: float) -> np.ndarray:
    """Points on the wall to the left of the tiny drive, on stripes' middles."""
    return np.array([[x, 8.0, 2.0] for x in along])


def test_the_record_keeps_sharp_points_and_says_which_frames_see_them():
    """Of four points one is blurred, one lies behind a camera, and one nobody sees."""
    seen = Observations(
        image=np.array([0, 1, 0, 2, 1, 2]),
        point=np.array([0, 0, 1, 1, 3, 3]),
        error=np.array([0.5, 1.5, MAX_MEAN_ERROR, MAX_MEAN_ERROR + 0.1, 0.1, np.inf]),
        positions=np.arange(12.0).reshape(4, 3),
        numbers=np.array([7, 8, 9, 11]),
    )
    record = triangulated_points((10, 20, 30), seen)
    np.testing.assert_array_equal(record.points, [[0.0, 1.0, 2.0]])
    assert record.seen_by.tolist() == [10, 20] and record.seen_point.tolist() == [0, 0]
    sharper = dataclasses.replace(seen, error=np.array([0.5, 1.5, 0.2, 0.2, 0.1, 0.3]))
    record = triangulated_points((10, 20, 30), sharper)
    np.testing.assert_array_equal(record.points, seen.positions[[0, 1, 3]])
    assert record.seen_by.tolist() == [10, 20, 10, 30, 20, 30]
    assert record.seen_point.tolist() == [0, 0, 1, 1, 2, 2]


def test_only_points_of_two_training_images_become_seeds(tiny_scene):
    points = wall(17.0, 19.0, 21.0, 23.0)
    seen_by = [frames_of(tiny_scene, *at) for at in ((0, 1), (1, 2), (2, 6), (3, 4, 6))]
    chosen, times = lidar_seed.triangulated_points(tiny_scene, job(), record_of(points, seen_by))
    np.testing.assert_array_equal(chosen, points[[0, 3]])
    moments = {i: tiny_scene.frames[key_frame(tiny_scene, i)].timestamp for i in range(10)}
    np.testing.assert_allclose(times, [(moments[0] + moments[1]) / 2, (moments[3] + moments[4]) / 2])
    seed = seed_points(tiny_scene, job(), triangulated=record_of(points, seen_by))
    assert seed.note["triangulated"] == 2
    for point, expected in zip(points, (True, False, False, True), strict=True):
        assert (np.abs(seed.positions - point).max(axis=1) < 1e-4).any() == expected


def test_their_colours_are_those_of_training_images(tiny_root, tmp_path):
    """With held-out images painted over, no seed shows the paint."""
    scene = scene_at(shutil.copytree(tiny_root, tmp_path / "nuscenes"))
    held_out = [i for i in range(10) if i not in TRAINING]
    for index in held_out:
        frame = scene.frames[key_frame(scene, index)]
        Image.new("RGB", (frame.width, frame.height), (255, 0, 255)).save(frame.image_path)
    along = np.arange(15.0, 30.0, 2.0)
    record = record_of(wall(*along), [frames_of(scene, 1, 2, 3)] * len(along))
    seed = seed_points(scene, job(), triangulated=record)
    assert seed.note["triangulated"] == len(along)
    own = np.array([np.abs(seed.positions - point).max(axis=1).argmin() for point in record.points])
    empty = World(things=[])
    truth = [cast(empty, CAMERA_AT, (point - CAMERA_AT)[None], 0.0)[1][0] for point in record.points]
    assert np.abs(seed.colors[own].astype(float) - truth).max() < 40


@pytest.mark.parametrize(
    "content",
    [b"no archive", {"points": np.zeros((1, 3))}, {**vars(no_points()), "seen_by": np.zeros(1, dtype=np.int64)}],
    ids=["no archive", "arrays lack", "lengths differ"],
)
def test_a_broken_file_is_named_with_its_rule(tmp_path, content):
    path = tmp_path / "triangulated.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write_arrays(path, content)
    with pytest.raises(ResultError, match=r"triangulated.npz: .*the rule 'refine_poses' rebuilds it"):
        read_triangulated(path)
