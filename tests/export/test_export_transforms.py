"""transforms.json: the recorded cameras in nerfstudio's conventions, which its documentation states."""

import json
from collections import Counter

import numpy as np
import pytest
from helpers.hand_made import recording_of

from drivesplat.export.camera_files import transforms_record
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse


@pytest.fixture(scope="module")
def recording(tiny_scene):
    """Trained at half the recorded width, every fourth key frame held out."""
    return recording_of(tiny_scene, width=48, every_nth=4, offset=2)


@pytest.fixture(scope="module")
def transforms(recording):
    return json.loads(json.dumps(transforms_record(recording.scene, recording.record)))


def by_nerfstudio(frame: dict, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) and distances along the view (n,) of world points: the camera has x to the right, y up and looks
    along -z; pixel (column, row) covers the image from there on."""
    camera_to_world = np.array(frame["transform_matrix"])
    x, y, z = (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera_to_world).T)[:, :3].T
    pixels = np.stack([frame["cx"] + frame["fl_x"] * x / -z, frame["cy"] - frame["fl_y"] * y / -z], axis=1)
    return pixels, -z


def test_points_fall_on_the_pixels_of_the_recorded_cameras(recording, transforms):
    assert len(transforms["frames"]) == len(recording.scene.frames) == 19
    rng = np.random.default_rng(0)
    for frame, entry in zip(recording.scene.frames, transforms["frames"], strict=True):
        points = frame.ego_to_world[:3, 3] + rng.uniform([8, -4, -1], [30, 4, 4], (20, 3))
        size = (frame.width, frame.height)
        expected, depths = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        found, along = by_nerfstudio(entry, points)
        assert (entry["w"], entry["h"]) == size == (96, 54) and (depths > 0).all()
        np.testing.assert_allclose(found, expected, atol=1e-9)
        np.testing.assert_allclose(along, depths, atol=1e-9)


def test_cameras_are_upright_and_look_along_the_drive(transforms):
    for entry in transforms["frames"]:
        pose = np.array(entry["transform_matrix"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert pose[2, 1] > 0.9 and -pose[0, 2] > 0.9, "y is up, -z is ahead"


def test_splits_name_each_image_once(recording, transforms):
    names = [entry["file_path"] for entry in transforms["frames"]]
    assert len(set(names)) == 19 and all(name.startswith("images/") for name in names)
    held_out = recording.record.splits["interpolation"]
    assert len(held_out) and transforms["train_filenames"] == [names[i] for i in recording.record.train_images]
    assert transforms["val_filenames"] == transforms["test_filenames"] == [names[i] for i in held_out]
    assert max(Counter([*transforms["train_filenames"], *transforms["val_filenames"]]).values()) == 1


def test_without_held_out_images_nerfstudio_splits_itself(tiny_scene):
    transforms = transforms_record(tiny_scene, recording_of(tiny_scene).record)
    assert not {"train_filenames", "val_filenames", "test_filenames"} & transforms.keys()


def test_the_record_contains_no_paths_of_the_machine(transforms, tiny_root):
    assert str(tiny_root) not in json.dumps(transforms)
    assert all((tiny_root / entry["file_path"].removeprefix("images/")).is_file() for entry in transforms["frames"])
