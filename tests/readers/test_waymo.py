"""The Waymo Open Dataset: one drive through nuScenes' tables, v2 and v1 gives the same scene."""

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import drives
from helpers.waymo_drive import GLOBAL, NAME, READOUT_S, Drive, panoptic, tiny_drive
from helpers.waymo_files import write_v1, write_v2
from PIL import Image

from drivesplat.preprocess.extract import extract_scene
from drivesplat.preprocess.masks import make_masks
from drivesplat.readers.sweeps import read_returns
from drivesplat.readers.waymo.calibration import readout_middle
from drivesplat.readers.waymo.segment import ImageRecord
from drivesplat.readers.waymo.sweep_file import rays_of
from drivesplat.scene.rigid import apply
from drivesplat.scene.scene import Scene, read_scene, write_scene
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.masks import MaskJob

pytestmark = pytest.mark.usefixtures("uncompared")

VERSIONS = ("v2", "v1")
KEY_FRAMES = 6
WRITERS = {"v2": write_v2, "v1": write_v1}


def source(**changes: Any) -> SceneSource:
    given = {"dataset": "mine", "reader": "waymo", "version": "", "scene": NAME, "lidar_sweeps": True}
    return drives.source(**{**given, "cameras": ("FRONT", "SIDE_LEFT"), **changes})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> tuple[Drive, Scene]:
    """A tiny drive as Waymo records it, and as nuScenes' tables give it."""
    world = drives.World(key_frames=KEY_FRAMES)
    return tiny_drive(drives.write_world(tmp_path_factory.mktemp("tables"), world), world)


@pytest.fixture(scope="module")
def roots(recorded, tmp_path_factory) -> dict[str, Path]:
    return {version: WRITERS[version](tmp_path_factory.mktemp(version), recorded[0]) for version in VERSIONS}


@pytest.fixture(scope="module")
def scenes(roots, tmp_path_factory) -> dict[str, Scene]:
    return {
        version: extract_scene(source(), root, None, tmp_path_factory.mktemp(f"results_{version}"))
        for version, root in roots.items()
    }


def moved(pose: np.ndarray, scene: Scene) -> np.ndarray:
    """A pose of nuScenes' scene in the world of a Waymo scene."""
    there = GLOBAL @ pose
    there[..., :3, 3] -= scene.origin
    return there


@pytest.mark.parametrize("version", VERSIONS)
def test_the_scene_is_that_of_the_tables_in_all_that_the_format_can_hold(version, scenes, recorded):
    scene, (drive, other) = scenes[version], recorded
    assert scene.version == version and scene.poses == "waymo" and "Non-Commercial" in scene.licence
    np.testing.assert_array_equal(scene.key_frame_timestamps, other.key_frame_timestamps)
    assert scene.key_frame_hz == other.key_frame_hz and scene.missing_images == 0
    np.testing.assert_array_equal(scene.origin, drive.frames[int(other.key_frame_timestamps[0])][:3, 3])
    front = [frame for frame in scene.frames if frame.camera == "FRONT"]
    for mine, theirs in zip(front, other.frames, strict=True):
        assert (mine.width, mine.height) == (theirs.width, theirs.height)
        assert (mine.is_key_frame, mine.sample_index) == (True, theirs.sample_index)
        assert abs(mine.timestamp - theirs.timestamp) <= 1
        np.testing.assert_allclose(mine.intrinsics, theirs.intrinsics, atol=1e-12)
        for name in ("camera_to_world", "ego_to_world"):
            np.testing.assert_allclose(getattr(mine, name), moved(getattr(theirs, name), scene), atol=1e-9)
        assert Path(mine.image_path).read_bytes() == Path(theirs.image_path).read_bytes()
    for mine, theirs in zip(scene.tracks, other.tracks, strict=True):
        assert mine.id == theirs.id
        np.testing.assert_array_equal(mine.timestamps, theirs.timestamps)
        np.testing.assert_array_equal(mine.sample_indices, theirs.sample_indices)
        np.testing.assert_allclose(mine.size, theirs.size, atol=1e-12)
        np.testing.assert_allclose(mine.object_to_world, moved(theirs.object_to_world, scene), atol=1e-9)
        assert mine.visibility.tolist() == [0] * len(mine.timestamps)


def test_both_versions_give_one_scene(scenes, tmp_path):
    """To the last bit, but for the names of files and the version."""
    texts = []
    for version, scene in scenes.items():
        names = {"image_path": lambda frame: Path(frame.image_path).name, "path": lambda sweep: Path(sweep.path).name}
        frames = tuple(replace(frame, image_path=names["image_path"](frame)) for frame in scene.frames)
        sweeps = tuple(replace(sweep, path=names["path"](sweep)) for sweep in scene.sweeps)
        write_scene(tmp_path / f"{version}.json", replace(scene, version="", frames=frames, sweeps=sweeps))
        texts.append((tmp_path / f"{version}.json").read_text())
        assert len(read_scene(tmp_path / f"{version}.json").sweeps) == len(scene.sweeps)
    assert texts[0] == texts[1]
    for one, other in zip(*(scene.sweeps for scene in scenes.values()), strict=True):
        assert Path(one.path).read_bytes() == Path(other.path).read_bytes()


@pytest.mark.parametrize("version", VERSIONS)
def test_without_cameras_a_segment_has_its_sweeps_and_boxes_alone(version, roots, scenes, tmp_path):
    alone = extract_scene(source(version=version, cameras=()), roots[version], results=tmp_path)
    assert alone.frames == alone.cameras == ()
    for name in ("sweeps", "tracks", "key_frame_timestamps"):
        assert len(getattr(alone, name)) == len(getattr(scenes[version], name)) > 0


def test_cameras_keep_size_mount_and_readout(scenes, recorded):
    front, left = scenes["v1"].cameras
    assert (front.name, front.width, front.height) == ("FRONT", 96, 54)
    assert (left.name, left.width, left.height) == ("SIDE_LEFT", 96, 38)
    assert (front.readout_direction, left.readout_direction) == ("right", "down")
    assert front.readout_s == pytest.approx(READOUT_S, abs=1e-6) == left.readout_s
    for scene in scenes.values():
        middles = {frame.readout_middle_s for frame in scene.frames}
        assert max(map(abs, middles)) < 0.05
    frame = next(frame for frame in scenes["v1"].frames if frame.camera == "SIDE_LEFT")
    with Image.open(frame.image_path) as image:
        assert image.size == (96, 38)
    ahead, to_left = frame.ego_to_world[:3, 0], frame.ego_to_world[:3, 1]
    np.testing.assert_allclose(frame.camera_to_world[:3, 2], to_left, atol=1e-9)
    np.testing.assert_allclose(frame.camera_to_world[:3, 0], ahead, atol=1e-9)
    np.testing.assert_allclose(frame.camera_to_world[:3, 1], [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize("version", VERSIONS)
def test_points_of_range_images_are_where_the_rays_end(version, scenes, recorded):
    """Each within 2 cm, in the order of rows, and no other."""
    scene, (drive, _) = scenes[version], recorded
    assert [lidar.name for lidar in scene.lidars] == ["TOP", "FRONT", "REAR"]
    by_token = {sweep.token: sweep for sweep in scene.sweeps}
    names = {1: "TOP", 2: "FRONT", 5: "REAR"}
    assert len(by_token) == len(drive.sweeps) == 3 * KEY_FRAMES
    for recording in drive.sweeps:
        sweep = by_token[f"{names[recording.laser]}/{recording.frame}"]
        returns = read_returns(sweep)
        ends = recording.hits.reshape(-1, 3)
        there = np.isfinite(ends[:, 0])
        points = apply(sweep.sensor_to_world, returns.points)
        assert points.shape == ends[there].shape and len(points) > 300
        assert np.abs(points - (ends[there] - scene.origin)).max() < 0.02
        np.testing.assert_allclose(returns.intensity, np.tanh(0.25), atol=1e-6)
        rows = np.repeat(np.arange(recording.values.shape[0]), recording.values.shape[1])
        np.testing.assert_array_equal(returns.rings, rows[there])


def test_dropped_returns_stay_as_rays(scenes, recorded):
    drive, scene = recorded[0], scenes["v1"]
    sweep = next(sweep for sweep in scene.sweeps if sweep.lidar == "TOP")
    with np.load(sweep.path) as arrays:
        rays = rays_of(arrays["azimuth"], arrays["elevation"], arrays["range"].astype(np.float64))
    recording = drive.sweeps[0]
    values = recording.values[..., 0].ravel()
    assert len(rays.range) == values.size and 0.1 < (values < 0).mean() < 0.8
    np.testing.assert_array_equal(np.isnan(rays.range), values < 0)
    np.testing.assert_allclose(rays.range[values > 0], values[values > 0], rtol=1e-6)
    elevations = scene.lidars[0].beam_elevations
    assert (np.diff(elevations) < 0).all() and len(elevations) == 64 and scene.lidars[0].azimuth_steps == 120
    np.testing.assert_allclose(rays.elevation, elevations[rays.row])
    assert rays.azimuth[0] > rays.azimuth[1]
    low = scene.lidars[1].beam_elevations
    assert len(low) == 20 and low[0] == pytest.approx(np.pi / 6 - np.pi / 60) and low[-1] > -np.pi / 2


def test_a_frame_range_renumbers_key_frames_and_writes_no_others(roots, recorded, tmp_path):
    """A second extraction writes the same bytes and leaves nothing old."""
    for version, root in roots.items():
        kept = []
        for frames in (None, (2, 5), None):
            scene = extract_scene(source(frames=frames, cameras=("FRONT",)), root, None, folder := tmp_path / version)
            kept.append({file.relative_to(folder): file.read_bytes() for file in folder.rglob("*.*")})
            if frames:
                np.testing.assert_array_equal(scene.key_frame_timestamps, recorded[1].key_frame_timestamps[2:5])
                assert [frame.sample_index for frame in scene.frames] == [0, 1, 2] and scene.key_frame_range == [2, 5]
                np.testing.assert_allclose(scene.frames[0].ego_to_world[:3, 3], 0.0, atol=0.2)
        assert kept[0] == kept[2] and [path.suffix for path in kept[1]].count(".jpg") == 3
        assert [path.suffix for path in kept[1]].count(".npz") == 9


def test_floats_of_single_precision_and_keys_as_text_are_read(recorded, scenes, tmp_path):
    root = write_v2(tmp_path / "data", recorded[0], single=True, text_keys=True)
    scene = extract_scene(source(), root, None, tmp_path / "results")
    assert len(scene.sweeps) == 3 * KEY_FRAMES
    for mine, theirs in zip(scene.frames, scenes["v2"].frames, strict=True):
        np.testing.assert_allclose(
            apply(mine.camera_to_world, np.zeros((1, 3))) + scene.origin,
            apply(theirs.camera_to_world, np.zeros((1, 3))) + scenes["v2"].origin,
            atol=0.01,
        )


SKY, ROAD, UNDEFINED, NONE = 25, 20, 0, 255


@pytest.mark.parametrize("version", VERSIONS)
def test_labelled_images_give_sky_masks_and_class_maps(version, recorded, tmp_path):
    """The label wins over the heuristic of the sky; images without one have it, and no classes."""
    classes = np.full((54, 96), ROAD)
    classes[40:], classes[:, 50:] = SKY, UNDEFINED
    frame = recorded[0].images[6].frame
    root = WRITERS[version](tmp_path / "data", replace(recorded[0], labels=[panoptic(frame, 1, classes)]))
    scene = extract_scene(source(cameras=("FRONT",)), root, None, tmp_path / "results")
    assert scene.sky_class == SKY
    assert [bool(f.classes_path) for f in scene.frames] == [i == 3 for i in range(KEY_FRAMES)]
    with Image.open(scene.frames[3].classes_path) as image:
        np.testing.assert_array_equal(np.asarray(image), np.where(classes == UNDEFINED, NONE, classes))
    job = MaskJob.model_validate({"masks": {}, "holdout": {}, "images": {}})
    record = make_masks(scene, job, tmp_path / "masks")
    assert record.semantic_classes == ROAD + 1
    sky, semantic = (
        [np.asarray(Image.open(tmp_path / f"masks/{kind}/FRONT/{f.timestamp}.png")) for f in scene.frames]
        for kind in ("sky", "semantic")
    )
    np.testing.assert_array_equal(sky[3] == 255, classes == SKY)
    assert (sky[2] == 255)[:20].mean() > 0.2 and not (sky[2] == 255)[40:].any()
    np.testing.assert_array_equal(semantic[3], np.where(classes == ROAD, ROAD, NONE))
    assert all((semantic[i] == NONE).all() for i in range(KEY_FRAMES) if i != 3)


def test_class_maps_of_distorted_images_are_resampled_as_the_images(recorded, tmp_path):
    drive = recorded[0]
    classes = np.repeat(np.arange(24).reshape(3, 8), 18, axis=0).repeat(12, axis=1)
    png = BytesIO()
    Image.fromarray((10 * classes).astype(np.uint8)).convert("RGB").save(png, "PNG")
    first = replace(drive.images[0], content=png.getvalue())
    front = replace(drive.cameras[0], intrinsic=[*drive.cameras[0].intrinsic[:4], 0.05, -0.3, 0.002, -0.002, 0.0])
    changed = replace(
        drive, images=[first, *drive.images[1:]], cameras=[front], labels=[panoptic(first.frame, 1, classes)]
    )
    scene = extract_scene(source(cameras=("FRONT",)), write_v2(tmp_path / "data", changed), None, tmp_path / "results")
    assert scene.cameras[0].distortion_model == "none" and "undistorted" in scene.frames[0].image_path
    labels, image = (
        np.asarray(Image.open(path)) for path in (scene.frames[0].classes_path, scene.frames[0].image_path)
    )
    expected = np.rint(image[..., 0] / 10.0)
    inside = np.where(labels == NONE, 0, labels) == expected
    assert inside.mean() > 0.8 and (labels != np.where(classes == 0, NONE, classes)).any()


def test_the_middle_of_the_readout_counts_from_the_time_of_the_pose():
    cases = (9.99, 10.03, 0.01), (9.96, 10.0, -0.02), (0.0, 10.03, 0.0), (3.0, 3.04, 0.0), (None, 10.03, 0.0)
    for trigger, done, expected in cases:
        image = ImageRecord(10_000_000, 1, None, 10.0, 0.004, trigger, done)
        assert readout_middle(image) == pytest.approx(expected)
