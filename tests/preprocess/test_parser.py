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

HOLDOUT = HoldoutSettings(every_nth=4, offset=2, last_block=2)


def job(width=None, holdout=HOLDOUT) -> ParserJob:
    return ParserJob(holdout=holdout, images=ImageSettings(width=width))


@pytest.fixture(scope="module")
def seed() -> PointCloud:
    random = np.random.default_rng(0)
    note = {"lidar": 40, "points_file": 0, "far": 10, "lidar_missing": 3, "extra_points": None, "provenance": {"a": 1}}
    return PointCloud(
        random.normal(size=(50, 3)).astype(np.float32), random.integers(0, 256, (50, 3)).astype(np.uint8), note
    )


def test_the_record_has_the_keys_and_shapes_of_gsplats_example_trainer(tiny_scene, seed):
    record = training_record(tiny_scene, seed, job())
    images, points = 19, 50
    shapes = {
        "Ks": (images, 3, 3), "camtoworlds": (images, 4, 4), "ego_to_world": (images, 4, 4),
        "image_sizes": (images, 2), "camera_indices": (images,),
        "timestamps": (images,), "sample_indices": (images,), "is_key_frame": (images,), "points": (points, 3),
        "points_rgb": (points, 3),
    }  # fmt: skip
    assert {key: getattr(record, key).shape for key in shapes} == shapes
    assert record.points_rgb.dtype == np.uint8
    assert len(record.image_paths) == len(record.image_names) == images
    assert record.camera_names == ["CAM_FRONT"]
    assert isinstance(record.scene_scale, float)


def test_images_keep_their_order_paths_times_and_poses(tiny_scene, seed):
    record = training_record(tiny_scene, seed, job())
    for i, frame in enumerate(tiny_scene.frames):
        assert record.image_paths[i] == frame.image_path
        assert record.image_names[i] == frame.image_path.rsplit("/", 1)[1]
        assert record.timestamps[i] == frame.timestamp
        assert record.sample_indices[i] == frame.sample_index
        assert record.is_key_frame[i] == frame.is_key_frame
        np.testing.assert_array_equal(record.camtoworlds[i], frame.camera_to_world)
        np.testing.assert_array_equal(record.ego_to_world[i], frame.ego_to_world)
    np.testing.assert_array_equal(record.points, seed.positions)
    np.testing.assert_array_equal(record.points_rgb, seed.colors)


def test_splits_are_disjoint_and_cover_every_image(tiny_scene, seed):
    record = training_record(tiny_scene, seed, job())
    assert record.splits.keys() == {"train", "interpolation", "extrapolation", "side_camera", "excluded"}
    together = np.concatenate(list(record.splits.values()))
    np.testing.assert_array_equal(np.sort(together), np.arange(19))
    groups = frame_groups(tiny_scene, HOLDOUT)
    for group, images in record.splits.items():
        assert all(groups[i] == group for i in images)
    assert [record.sample_indices[i] for i in record.splits["interpolation"]] == [2, 6]
    assert [record.sample_indices[i] for i in record.splits["extrapolation"]] == [8, 9]
    assert record.held_out_frames == {"interpolation": [2, 6], "extrapolation": [8, 9]}


@pytest.mark.parametrize(("width", "size"), [(None, (96, 54)), (48, (48, 27)), (64, (64, 36)), (192, (192, 108))])
def test_intrinsics_refer_to_the_training_size(tiny_scene, seed, width, size):
    """Continuous convention: the image's centre is at half its width and height, whatever the size."""
    record = training_record(tiny_scene, seed, job(width))
    np.testing.assert_array_equal(record.image_sizes, [size] * 19)
    focal = 0.62 * size[0]
    expected = [[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(record.Ks, [expected] * 19)


def test_the_scene_scale_is_the_distance_of_the_farthest_training_camera_from_their_mean(tiny_scene, seed):
    """The tiny drive's camera moves along x at a steady speed; a scene is at least a metre large."""
    record = training_record(tiny_scene, seed, job())
    train = record.camtoworlds[record.splits["train"], 0, 3]
    assert record.scene_scale == pytest.approx(np.abs(train - train.mean()).max())
    still = [dataclasses.replace(frame, camera_to_world=np.eye(4)) for frame in tiny_scene.frames]
    assert training_record(dataclasses.replace(tiny_scene, frames=tuple(still)), seed, job()).scene_scale == 1.0


def test_the_record_describes_scene_and_seed(tiny_scene, seed):
    scene = dataclasses.replace(tiny_scene, missing_images=2, key_frame_range=[0, 10], poses="refined")
    record = training_record(scene, seed, job())
    assert dataclasses.asdict(record.scene) == {
        "name": "0001", "dataset": "tiny", "version": "v1.0-mini", "poses": "refined", "key_frame_range": [0, 10],
        "missing_images": 2, "key_frame_hz": 2.0,
    }  # fmt: skip
    assert dataclasses.asdict(record.seed) == {
        "lidar": 40, "triangulated": 0, "points_file": 0, "far": 10, "lidar_missing": 3, "extra_points": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    "holdout",
    [HoldoutSettings(every_nth=1, offset=0), HoldoutSettings(last_block=10), HoldoutSettings(last_block=99)],
)
def test_a_scene_without_training_images_is_refused_with_the_hold_out_settings(tiny_scene, seed, holdout):
    key_frames = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    scene = dataclasses.replace(tiny_scene, frames=key_frames)
    with pytest.raises(DatasetError, match=r"0001.*holdout\.every_nth.*holdout\.last_block"):
        training_record(scene, seed, job(holdout=holdout))


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
