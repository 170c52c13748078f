"""Figures of held-out key frames beside PSNR: the error of depth, distances to training images, brightness."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from helpers.drives import HELD_OUT, NOTHING_HELD_OUT, World
from helpers.hand_made import recording_of, round_gaussians
from PIL import Image

from drivesplat.evaluation.eval_record import summarize_drive
from drivesplat.evaluation.image_metrics import evaluate_groups, held_out_depths, measured_images
from drivesplat.evaluation.metrics import MIN_REGION_PIXELS, depth_summary, relative_depth_errors
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.splat_model import SplatModel
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import LABELS
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.lidar_depth import LidarDepthJob


def job(holdout: dict[str, int] = HELD_OUT) -> LidarDepthJob:
    spacing = {"ray_spacing": (1.5, 1.65), "box_margin": 0.1, "own_car_radius": 2.5}
    return LidarDepthJob.model_validate({"holdout": holdout, "images": {"width": None}, **spacing})


@pytest.fixture(scope="module")
def recording(tiny_scene) -> EvaluationData:
    return recording_of(tiny_scene, **HELD_OUT)


def known(rows: np.ndarray, columns: np.ndarray, depth: np.ndarray) -> PixelDepths:
    return PixelDepths(rows.astype(np.int32), columns.astype(np.int32), depth.astype(np.float32))


def test_the_figure_is_the_median_over_all_pixels_of_the_group():
    """It is neither the mean nor the mean of the images' medians: the first image has a third of the pixels."""
    random, errors = np.random.default_rng(0), []
    expected = []
    for count, spread in ((500, 0.3), (1000, 0.05)):
        places = random.permutation(40 * 50)[:count]
        depth, off = random.uniform(3.0, 60.0, count), random.normal(size=count) * spread
        image = np.full((40, 50), np.nan, dtype=np.float32)
        image[places // 50, places % 50] = depth * (1.0 + off)
        errors.append(relative_depth_errors(image, known(places // 50, places % 50, depth)))
        expected.append(np.abs(off))
    record = depth_summary(errors)["depth"]
    assert record["median_relative_error"] == pytest.approx(np.median(np.concatenate(expected)), rel=1e-3)
    assert record["pixels"] == 1500 and json.dumps(record, allow_nan=False)


def test_too_few_pixels_give_null_and_no_sweep_gives_no_entry():
    assert depth_summary([]) == {}
    for count in (0, MIN_REGION_PIXELS - 1):
        pixels = known(np.zeros(count), np.arange(count), np.ones(count))
        assert depth_summary([relative_depth_errors(np.ones((1, 1000), np.float32), pixels)]) == {"depth": None}


def test_images_are_compared_with_the_sweep_of_their_own_key_frame(recording):
    """The depths are those of a training without hold-out. Only held-out key frames are measured."""
    everything = lidar_depths(recording.scene, job(NOTHING_HELD_OUT))
    groups = frame_groups(recording.scene, HoldoutSettings(**HELD_OUT))
    depths = held_out_depths(recording, "CAM_FRONT", job())
    assert [recording.scene.frames[i].sample_index for i in sorted(depths)] == [2, 6, 8, 9]
    assert {groups[i] for i in depths} == {"interpolation", "extrapolation"}
    for index, image in depths.items():
        assert len(image.depth) > 100
        for key, values in vars(image).items():
            np.testing.assert_array_equal(values, vars(everything[index])[key])


def test_groups_include_the_depth_error(recording):
    """The first held-out image shows a disc at 5 m whose LiDAR depth is 4 m; the second has no LiDAR depth."""
    pose = recording.scene.frames[4].camera_to_world
    model = SplatModel([round_gaussians([pose[:3, 3] + 5.0 * pose[:3, 2]], 2.0, 0.999)], None).requires_grad_(False)
    rows, columns = (values.ravel() for values in np.mgrid[10:40, 20:70])
    depths = {4: known(rows, columns, np.full(len(rows), 4.0))}
    groups = evaluate_groups(model, recording, "CAM_FRONT", None, torch.device("cpu"), depths)
    assert groups["interpolation"]["depth"] == {"median_relative_error": pytest.approx(0.25, abs=2e-3), "pixels": 1500}
    assert "depth" not in groups["extrapolation"]


def record_of(scene: Scene) -> dict:
    recording = recording_of(scene, **HELD_OUT)
    return summarize_drive(recording, "CAM_FRONT", measured_images(recording.record, "CAM_FRONT"))


def test_from_training_m_is_the_distance_driven_since_the_nearest_training_image(tiny_scene):
    """At 4 m/s with an image every 0.25 s: those 0.25 s before key frames 2, 6 and 8 are trained on, since cameras
    fire 35 ms early, but not those 0.25 s after. Key frame 9 follows the last training image by 0.75 s."""
    record = record_of(tiny_scene)
    assert record["interpolation"]["from_training_m"] == pytest.approx(1.0)
    assert record["extrapolation"]["from_training_m"] == pytest.approx((1.0 + 3.0) / 2)
    assert record["moved_m"] == pytest.approx(18.0) and record["seconds"] == pytest.approx(4.5)
    keys = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    record = record_of(dataclasses.replace(tiny_scene, frames=keys))
    assert record["interpolation"]["from_training_m"] == pytest.approx(2.0)
    assert record["extrapolation"]["from_training_m"] == pytest.approx((2.0 + 4.0) / 2)


def test_brightness_covers_held_out_images_and_flat_psnr_their_static_pixels(tiny_scene):
    recording, record = recording_of(tiny_scene, **HELD_OUT), record_of(tiny_scene)
    measured = measured_images(recording.record, "CAM_FRONT")
    for group, key_frames in (("interpolation", (2, 6)), ("extrapolation", (8, 9))):
        assert [recording.frame(i).sample_index for i in measured[group]] == list(key_frames)
        images = [np.asarray(Image.open(recording.frame(i).image_path), dtype=float) / 255.0 for i in measured[group]]
        luma = np.mean([0.2126 * i[..., 0] + 0.7152 * i[..., 1] + 0.0722 * i[..., 2] for i in images])
        assert record[group]["luminance"] == pytest.approx(luma)
        still = [recording.labels(i) == LABELS["static"] for i in measured[group]]
        pixels = np.concatenate([image[mask] for image, mask in zip(images, still, strict=True)])
        assert 1000 < len(pixels) < 2 * World().width * World().height
        flat = np.mean((pixels - pixels.mean(axis=0)) ** 2)
        assert record[group]["flat_psnr"] == pytest.approx(-10 * np.log10(flat))
