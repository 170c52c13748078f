"""The text model of COLMAP, as pycolmap reads it."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from helpers.hand_made import recording_of

from drivesplat.errors import ResultError
from drivesplat.export.camera_files import ColmapFiles, export_colmap
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse

FILES = ("cameras.txt", "images.txt", "points3D.txt")


@pytest.fixture(scope="module")
def record(tiny_scene):
    rng = np.random.default_rng(0)
    points, colors = rng.uniform(-50, 300, (25, 3)).astype(np.float32), rng.integers(0, 256, (25, 3), dtype=np.uint8)
    return dataclasses.replace(recording_of(tiny_scene, width=48).record, points=points, points_rgb=colors)


def exported(folder, scene, record) -> pycolmap.Reconstruction:
    export_colmap(ColmapFiles(*(folder / name for name in FILES)), scene, record)
    model = pycolmap.Reconstruction()
    model.read_text(str(folder))
    return model


def test_images_have_their_names_poses_and_intrinsics_and_points_are_the_seed(tmp_path, tiny_scene, record, tiny_root):
    model = exported(tmp_path, tiny_scene, record)
    assert len(model.images) == len(tiny_scene.frames) == 19 and len(model.cameras) == 1
    rng = np.random.default_rng(1)
    for frame in tiny_scene.frames:
        (image,) = (image for image in model.images.values() if frame.image_path.endswith(image.name))
        assert (tiny_root / image.name).is_file()
        size = (frame.width, frame.height)
        assert image.has_pose and (image.camera.width, image.camera.height) == size
        points = frame.ego_to_world[:3, 3] + rng.uniform([8, -4, -1], [30, 4, 4], (20, 3))
        expected, _ = project(points, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        np.testing.assert_allclose([image.project_point(point) for point in points], expected, atol=1e-6)
    assert sorted(model.points3D) == list(range(1, 26))
    for i, point in model.points3D.items():
        np.testing.assert_allclose(point.xyz, record.points[i - 1], atol=1e-4)
        assert point.color.tolist() == record.points_rgb[i - 1].tolist()


def test_cameras_of_a_rig_are_kept_apart(tmp_path, tiny_scene, record):
    """Every other image by a second camera with a longer focal length."""
    longer = np.diag([1.5, 1.5, 1.0])
    frames = tuple(
        dataclasses.replace(frame, camera="CAM_BACK", intrinsics=longer @ frame.intrinsics) if i % 2 else frame
        for i, frame in enumerate(tiny_scene.frames)
    )
    model = exported(tmp_path, dataclasses.replace(tiny_scene, frames=frames), record)
    assert len(model.cameras) == 2
    for frame in frames:
        (image,) = (image for image in model.images.values() if frame.image_path.endswith(image.name))
        assert image.camera.focal_length_x == pytest.approx(frame.intrinsics[0, 0])


def test_an_unwritable_file_is_named(tmp_path, tiny_scene, record):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match=r"file/cameras\.txt: cannot be written"):
        exported(tmp_path / "file", tiny_scene, record)
