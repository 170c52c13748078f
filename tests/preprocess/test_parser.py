"""parser.npz and parser.pkl: what a trainer needs, under the names that users of gsplat's example trainer know."""

import dataclasses
import pickle

import numpy as np
import pytest

from drivesplat.errors import DatasetError, ResultError
from drivesplat.io.array_file import write_arrays
from drivesplat.io.point_cloud import PointCloud
from drivesplat.io.typed_record import field_values
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.splits import frame_groups
from drivesplat.scene.training_record import read_training_record, write_training_pickle, write_training_record
from drivesplat.settings.images import HoldoutSettings, ImageSettings, ParserJob


@pytest.mark.parametrize("holdout", [{"every_nth": 1, "offset": 0}, {"last_block": 10}, {"last_block": 99}], ids=str)
def test_a_scene_without_training_images_is_refused_with_the_hold_out_settings(tiny_scene, seed, holdout):
    key_frames = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    scene = dataclasses.replace(tiny_scene, frames=key_frames)
    with pytest.raises(DatasetError, match=r"0001.*holdout\.every_nth.*holdout\.last_block"):
        training_record(scene, seed, job(**holdout))


def job(width=None, **holdout) -> ParserJob:
    settings = HoldoutSettings(**{"every_nth": 4, "offset": 2, "last_block": 2, **holdout})
    return ParserJob(holdout=settings, images=ImageSettings(width=width))


def test_the_record_has_what_gsplats_example_trainer_needs_of_scene_images_and_seed(tiny_scene, seed):
    scene = dataclasses.replace(tiny_scene, missing_images=2, key_frame_range=[0, 10], poses="refined")
    record = training_record(scene, seed, job())
    frames = scene.frames
    for values, expected in (
        (record.image_paths, [frame.image_path for frame in frames]),
        (record.image_names, [frame.image_path.rsplit("/", 1)[1] for frame in frames]),
        (record.timestamps, [frame.timestamp for frame in frames]),
        (record.sample_indices, [frame.sample_index for frame in frames]),
        (record.is_key_frame, [frame.is_key_frame for frame in frames]),
        (record.camtoworlds, [frame.camera_to_world for frame in frames]),
        (record.ego_to_world, [frame.ego_to_world for frame in frames]),
        (record.camera_indices, [0] * 19),
        (record.points, seed.positions),
        (record.points_rgb, seed.colors),
    ):
        np.testing.assert_array_equal(values, expected)
    assert record.points_rgb.dtype == np.uint8 and record.camera_names == ["CAM_FRONT"]
    assert isinstance(record.scene_scale, float)
    assert dataclasses.asdict(record.scene) == {
        "name": "0001", "dataset": "tiny", "version": "v1.0-mini", "poses": "refined", "key_frame_range": [0, 10],
        "missing_images": 2, "key_frame_hz": 2.0,
    }  # fmt: skip
    assert dataclasses.asdict(record.seed) == {
        "lidar": 40, "triangulated": 0, "points_file": 0, "far": 10, "lidar_missing": 3, "extra_points": None,
    }  # fmt: skip


def test_splits_are_disjoint_and_cover_every_image(tiny_scene, seed):
    record = training_record(tiny_scene, seed, job())
    assert record.splits.keys() == {"train", "interpolation", "extrapolation", "side_camera", "excluded"}
    np.testing.assert_array_equal(np.sort(np.concatenate(list(record.splits.values()))), np.arange(19))
    groups = frame_groups(tiny_scene, job().holdout)
    assert all(groups[i] == group for group, images in record.splits.items() for i in images)
    held_out = {"interpolation": [2, 6], "extrapolation": [8, 9]}
    assert {group: record.sample_indices[record.splits[group]].tolist() for group in held_out} == held_out
    assert record.held_out_frames == held_out


@pytest.mark.parametrize(("width", "size"), [(None, (96, 54)), (48, (48, 27)), (192, (192, 108))])
def test_intrinsics_refer_to_the_training_size(tiny_scene, seed, width, size):
    """Continuous convention: the image's centre is at half its width and height, whatever the size."""
    record = training_record(tiny_scene, seed, job(width))
    np.testing.assert_array_equal(record.image_sizes, [size] * 19)
    focal = 0.62 * size[0]
    expected = [[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(record.Ks, [expected] * 19)


@pytest.fixture(scope="module")
def seed() -> PointCloud:
    random = np.random.default_rng(0)
    note = {"lidar": 40, "points_file": 0, "far": 10, "lidar_missing": 3, "extra_points": None, "provenance": {"a": 1}}
    return PointCloud(
        random.normal(size=(50, 3)).astype(np.float32), random.integers(0, 256, (50, 3)).astype(np.uint8), note
    )


def test_the_scene_scale_is_the_distance_of_the_farthest_training_camera_from_their_mean(tiny_scene, seed):
    """The tiny drive's camera moves along x at a steady speed; a scene is at least a metre large."""
    record = training_record(tiny_scene, seed, job())
    train = record.camtoworlds[record.splits["train"], 0, 3]
    assert record.scene_scale == pytest.approx(np.abs(train - train.mean()).max())
    still = [dataclasses.replace(frame, camera_to_world=np.eye(4)) for frame in tiny_scene.frames]
    assert training_record(dataclasses.replace(tiny_scene, frames=tuple(still)), seed, job()).scene_scale == 1.0


def test_both_files_hold_the_whole_record(tiny_scene, seed, tmp_path):
    record = dataclasses.replace(
        training_record(tiny_scene, seed, job()), provenance={"stages": {"made": {}}, "inputs": {}}
    )
    write_training_record(tmp_path / "parser.npz", record)
    write_training_pickle(tmp_path / "parser.pkl", record)
    pickled = pickle.loads((tmp_path / "parser.pkl").read_bytes())
    assert {type(value) for value in pickled.values()} <= {np.ndarray, list, dict, float, type(None)}
    assert pickled["scene"]["name"] == "0001" and pickled["seed"]["lidar"] == 40
    again = read_training_record(tmp_path / "parser.npz")
    assert pickled.keys() == field_values(again).keys()
    for name, value in field_values(again).items():
        plain = field_values(value) if name in ("scene", "seed") else value
        np.testing.assert_equal(pickled[name], plain)
        np.testing.assert_equal(getattr(record, name), value)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"Ks": np.zeros((18, 3, 3))}, "camtoworlds is float64"),
        ({"camtoworlds": np.zeros((19, 3, 4))}, "camtoworlds is float64"),
        ({"points": np.zeros((49, 3), np.float32)}, "points_rgb is uint8"),
        ({"timestamps": np.zeros(19)}, "timestamps is float64"),
        ({"scene_scale": "1"}, "scene_scale is a str"),
        ({"image_names": []}, "it has 19 images"),
        ({"camera_indices": np.full(19, 1)}, "camera_indices has indices out of range"),
        ({"splits": {"train": np.array([19])}}, "splits has indices out of range"),
        ({"splits": {"train": np.array([0.5])}}, "splits has indices out of range"),
        ({"scene": {"name": "0001"}}, "it lacks dataset, version, poses"),
        ({"points": np.full((50, 3), np.nan, np.float32)}, "points is not finite"),
        ({"Ks": np.zeros((19, 3, 3))}, "Ks has a focal length that is not positive"),
        ({"image_sizes": np.zeros((19, 2), int)}, "image_sizes has a side outside 1 to 65535 pixels"),
        ({"image_sizes": np.full((19, 2), -96)}, "image_sizes has a side outside 1 to 65535 pixels"),
        ({"image_sizes": np.full((19, 2), 10**9)}, "image_sizes has a side outside 1 to 65535 pixels"),
        ({"splits": {}}, "splits has no training images"),
        ({"splits": {"train": np.empty(0, int)}}, "splits has no training images"),
        ({"scene_scale": -1.0}, "scene_scale is not positive"),
        ({"provenance": {"stages": {}}}, "its provenance lacks inputs"),
    ],
)
def test_a_record_with_inconsistent_fields_is_refused_with_the_reason(tiny_scene, seed, tmp_path, changes, reason):
    write_arrays(tmp_path / "parser.npz", field_values(training_record(tiny_scene, seed, job())) | changes)
    with pytest.raises(ResultError, match=rf"parser\.npz: not a record of a scene for training.*{reason}.*'parser'"):
        read_training_record(tmp_path / "parser.npz")
