"""One drive in five formats is one scene: poses, intrinsics, images, tracks, returns and seed points."""

from pathlib import Path

import numpy as np
import pytest
from helpers.drives import World
from helpers.format_drives import first_place, with_tracks_of, write_formats
from scipy.spatial import cKDTree

from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene
from drivesplat.settings.config import load
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.workflow.stages import stage_settings

pytest.importorskip("ncore")

OTHERS = ("drive", "waymo", "ncore", "bag")
POSES = {"drive": 1e-12, "waymo": 1e-9, "ncore": 1e-7, "bag": 1e-9}
"""Metres by which poses may differ from those of the tables. Of Waymo and NCore boxes are in other frames."""
POINTS = {"drive": 1e-12, "waymo": 2e-5, "ncore": 2e-5, "bag": 1e-9}
"""The same of returns, which Waymo and NCore store as ranges in single precision."""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict[str, Scene]:
    folder = tmp_path_factory.mktemp("formats")
    found = write_formats(folder, World(key_frames=5, sweeps_between=0))
    return {name: drive.extracted(folder / "results" / name) for name, drive in found.items()}


def in_order(scene: Scene) -> list:
    return sorted(scene.frames, key=lambda frame: frame.timestamp)


@pytest.mark.parametrize("name", OTHERS)
def test_images_have_the_same_poses_intrinsics_and_bytes(name, scenes):
    scene, tables = scenes[name], scenes["tables"]
    shift = first_place(scene) - first_place(tables)
    assert len(scene.frames) == len(tables.frames) == len(scene.key_frame_timestamps)
    for mine, theirs in zip(in_order(scene), in_order(tables), strict=True):
        assert abs(mine.timestamp - theirs.timestamp) <= 1
        for key in ("camera_to_world", "ego_to_world"):
            expected = getattr(theirs, key).copy()
            expected[:3, 3] += shift
            np.testing.assert_allclose(getattr(mine, key), expected, atol=POSES[name])
        np.testing.assert_allclose(mine.intrinsics, theirs.intrinsics, rtol=1e-6)
        assert (mine.width, mine.height) == (theirs.width, theirs.height)
        assert Path(mine.image_path).read_bytes() == Path(theirs.image_path).read_bytes()


@pytest.mark.parametrize("name", OTHERS)
def test_tracks_are_the_same_where_the_format_has_them(name, scenes):
    scene, tables = scenes[name], scenes["tables"]
    shift = first_place(scene) - first_place(tables)
    if name == "bag":
        assert not scene.tracks
        return
    assert [track.id for track in scene.tracks] == [track.id for track in tables.tracks]
    for mine, theirs in zip(scene.tracks, tables.tracks, strict=True):
        assert mine.object_class.is_vehicle == theirs.object_class.is_vehicle
        np.testing.assert_allclose(mine.size, theirs.size, atol=1e-6)
        np.testing.assert_array_equal(mine.timestamps, theirs.timestamps)
        expected = theirs.object_to_world.copy()
        expected[:, :3, 3] += shift
        np.testing.assert_allclose(mine.object_to_world, expected, atol=POSES[name])


@pytest.mark.parametrize("name", OTHERS)
def test_returns_are_at_the_same_places(name, scenes):
    scene, tables = scenes[name], scenes["tables"]
    shift = first_place(scene) - first_place(tables)
    for mine, theirs in zip(scene.sweeps, tables.sweeps, strict=True):
        points, expected = (apply(sweep.sensor_to_world, read_returns(sweep).points) for sweep in (mine, theirs))
        assert mine.timestamp == theirs.timestamp and len(points) == len(expected) > 1000
        np.testing.assert_allclose(points - shift, expected, atol=POINTS[name])


def seed(scene: Scene) -> np.ndarray:
    settings = {"datasets": {"nuscenes": {"scenes": ["0001"]}}, "lidar_seed": {"far_points": 0, "max_points": 10**6}}
    job = SeedJob.model_validate_json(stage_settings(load(settings), "lidar_seed", "0001"))
    found = seed_points(scene, job)
    assert found.note["lidar"] == len(found.positions) > 300
    return found.positions - first_place(scene)


@pytest.mark.parametrize("name", OTHERS)
def test_seed_points_are_the_same(name, scenes):
    """Each is near one of the tables' and the reverse, but for points at the edges of voxels. The bag is given the
    tracks of the tables, whose returns are no seed."""
    scene = scenes[name] if name != "bag" else with_tracks_of(scenes[name], scenes["tables"])
    mine, theirs = seed(scene), seed(scenes["tables"])
    for one, other in ((mine, theirs), (theirs, mine)):
        distances, _ = cKDTree(one).query(other)
        assert (distances < 2 * POINTS[name] + 2e-6).mean() > 0.97, "seeds are of single precision"
    assert len(mine) == pytest.approx(len(theirs), rel=0.01)
