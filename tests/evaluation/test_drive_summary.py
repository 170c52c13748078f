"""The summary of a drive: distances from held-out to training images, and brightness."""

import dataclasses

import numpy as np
import pytest
from helpers.drives import HELD_OUT, World
from PIL import Image

from drivesplat.evaluation.drive_summary import summarize_drive
from drivesplat.evaluation.image_metrics import measured_images
from drivesplat.io.point_cloud import PointCloud
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import LABELS
from drivesplat.scene.scene import Scene
from drivesplat.settings.images import ParserJob


def recording_of(scene: Scene, holdout=HELD_OUT) -> EvaluationData:
    seed = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), {})
    return EvaluationData(scene, training_record(scene, seed, ParserJob(holdout=holdout, images={})))


def record_of(recording: EvaluationData) -> dict:
    return summarize_drive(recording, "CAM_FRONT", measured_images(recording.record, "CAM_FRONT"))


def test_from_training_m_is_the_distance_driven_since_the_nearest_training_image(tiny_scene):
    """At 4 m/s with an image every 0.25 s: those 0.25 s before key frames 2, 6 and 8 are trained on, since cameras
    fire 35 ms early, but not those 0.25 s after. Key frame 9 follows the last training image by 0.75 s."""
    record = record_of(recording_of(tiny_scene))
    assert record["interpolation"]["from_training_m"] == pytest.approx(1.0)
    assert record["extrapolation"]["from_training_m"] == pytest.approx((1.0 + 3.0) / 2)
    assert record["moved_m"] == pytest.approx(18.0) and record["seconds"] == pytest.approx(4.5)
    keys = tuple(frame for frame in tiny_scene.frames if frame.is_key_frame)
    record = record_of(recording_of(dataclasses.replace(tiny_scene, frames=keys)))
    assert record["interpolation"]["from_training_m"] == pytest.approx(2.0)
    assert record["extrapolation"]["from_training_m"] == pytest.approx((2.0 + 4.0) / 2)


def test_brightness_covers_held_out_images_and_flat_psnr_their_static_pixels(tiny_scene):
    recording = recording_of(tiny_scene)
    measured = measured_images(recording.record, "CAM_FRONT")
    record = record_of(recording)
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
