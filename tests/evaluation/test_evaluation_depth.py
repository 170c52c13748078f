"""The error of rendered depth, and the LiDAR sweep that it is compared with."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.drives import HELD_OUT, NOTHING_HELD_OUT, scene_at
from helpers.hand_made import recording_of, round_gaussians

from drivesplat.evaluation.image_metrics import evaluate_groups, held_out_depths
from drivesplat.evaluation.metrics import MIN_REGION_PIXELS, depth_summary, relative_depth_errors
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.splat_model import SplatModel
from drivesplat.preprocess.lidar_depth import lidar_depths
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.lidar_depth import LidarDepthJob


def job(holdout: dict[str, int] = HELD_OUT) -> LidarDepthJob:
    return LidarDepthJob.model_validate(
        {
            "holdout": holdout, "images": {"width": None}, "own_car_radius": 2.5,
            "ray_spacing": (1.5, 1.65), "box_margin": 0.1,
        }
    )  # fmt: skip


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


@pytest.mark.parametrize(
    ("count", "summary"), [(None, {}), (0, {"depth": None}), (MIN_REGION_PIXELS - 1, {"depth": None})]
)
def test_too_few_pixels_give_null_and_no_sweep_gives_no_entry(count, summary):
    errors = []
    if count is not None:
        columns = np.arange(count)
        errors.append(
            relative_depth_errors(np.ones((1, 1000), np.float32), known(0 * columns, columns, np.ones(count)))
        )
    assert depth_summary(errors) == summary


def held_out_recording(root: Path) -> EvaluationData:
    return recording_of(scene_at(root), **HELD_OUT)


def test_images_are_compared_with_the_sweep_of_their_own_key_frame(tiny_root):
    """The depths are those of a training without hold-out. Only held-out key frames are measured."""
    recording = held_out_recording(tiny_root)
    everything = lidar_depths(recording.scene, job(NOTHING_HELD_OUT))
    groups = frame_groups(recording.scene, HoldoutSettings(**HELD_OUT))
    depths = held_out_depths(recording, "CAM_FRONT", job())
    assert [recording.scene.frames[i].sample_index for i in sorted(depths)] == [2, 6, 8, 9]
    assert {groups[i] for i in depths} == {"interpolation", "extrapolation"}
    for index, image in depths.items():
        assert len(image.depth) > 100
        for key, values in vars(image).items():
            np.testing.assert_array_equal(values, vars(everything[index])[key])


def test_groups_include_the_depth_error(tiny_root):
    """The first held-out image shows a disc at 5 m whose LiDAR depth is 4 m; the second has no LiDAR depth."""
    recording = held_out_recording(tiny_root)
    index = 4
    pose = recording.scene.frames[index].camera_to_world
    model = SplatModel([round_gaussians([pose[:3, 3] + 5.0 * pose[:3, 2]], 2.0, 0.999)], None).requires_grad_(False)
    rows, columns = (values.ravel() for values in np.mgrid[10:40, 20:70])
    groups = evaluate_groups(
        model, recording, "CAM_FRONT", None, torch.device("cpu"), {index: known(rows, columns, np.full(len(rows), 4.0))}
    )
    assert groups["interpolation"]["depth"] == {"median_relative_error": pytest.approx(0.25, abs=2e-3), "pixels": 1500}
    assert "depth" not in groups["extrapolation"]
