"""The protocol in eval.json: what it states of the hold-out at 2 Hz and at higher rates."""

from typing import Any

import numpy as np
import pytest
from helpers.records import EMPTY_MASKS, training_record_of

from drivesplat.evaluation.evaluate import protocol
from drivesplat.scene.training_record import SceneInfo
from drivesplat.settings.evaluate import EvaluateJob


def job_of(**holdout: Any) -> EvaluateJob:
    lidar = {"ray_spacing": [0.33, 1.33], "own_car_radius": 2.5, "box_margin": 0.3, "images": {}, "holdout": holdout}
    cameras = {"eval_camera": "CAM_FRONT", "cameras": ["CAM_FRONT"], "sweeps": False}
    return EvaluateJob.model_validate({**cameras, "holdout": holdout, "lidar": lidar, "lpips": False, "removal": None})


def stated(rate: float | None, train: list[int], **holdout: Any) -> dict[str, Any]:
    """The protocol of ten images, of which number 5 is held out and `train` are trained on."""
    scene = SceneInfo("0001", "tiny", "v1.0-mini", "nuscenes", key_frame_hz=rate)
    times = 1_700_000_000_000_000 + np.arange(10) * round(1e6 / (rate or 2))
    splits = {"train": train, "interpolation": [5], "extrapolation": []}
    arrays = {group: np.array(images, dtype=np.int64) for group, images in splits.items()}
    record = training_record_of(10, scene=scene, timestamps=times, splits=arrays)
    return protocol(record, EMPTY_MASKS, job_of(**holdout))


@pytest.mark.parametrize("rate", [None, 2.0, 4.9])
def test_below_5_hz_the_protocol_has_the_keys_that_it_always_had(rate):
    """The setting of the neighbourhood has no effect there, so that results with other values are comparable."""
    made = stated(rate, [0, 1, 2, 3, 4, 6, 7, 8, 9], neighbourhood_s=0.7)
    assert made["holdout"] == {"every_nth": 8, "offset": 4, "last_block": 4}
    assert list(made) == [
        "version", "cameras", "eval_camera", "width", "height", "sweeps", "holdout", "held_out_frames", "train_images",
        "poses", "regions", "visibility", "own_car", "extra_points", "lidar_missing", "images_missing",
        "key_frame_range",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("holdout", "train", "neighbourhood", "nearest"),
    [({}, [0, 1, 2, 8, 9], 0.25, 0.3), ({"neighbourhood_s": 0.0}, [0, 1, 2, 3, 4, 6, 7, 8, 9], 0.0, 0.1)],
)
def test_at_10_hz_it_states_rate_neighbourhood_and_distance_to_training(holdout, train, neighbourhood, nearest):
    made = stated(10.0, train, **holdout)
    assert made["holdout"]["neighbourhood_s"] == neighbourhood
    assert made["key_frame_hz"] == 10.0 and made["nearest_training_s"] == pytest.approx(nearest)
    assert stated(10.0, [])["nearest_training_s"] is None, "without training images there is no distance"
