"""Dropout: which Gaussians an iteration leaves out."""

import numpy as np
import pytest
import torch
from helpers.records import training_record_of
from helpers.trainings import inputs_in, job_of, settings_of, untrained_street

from drivesplat.model.gaussians import concatenate
from drivesplat.training.augmentation import dropout_share, with_dropout
from drivesplat.training.stage import prepare


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_random_share_of_the_static_gaussians_is_left_out(share):
    torch.manual_seed(0)
    model = untrained_street(settings_of())
    sets, moving = model.sample(model.states(0.5)), model.moving()
    gaussians = concatenate(sets)
    shown = [concatenate(with_dropout(sets, model, share)) for _ in range(400)]
    left_out = torch.stack([some.opacities != gaussians.opacities for some in shown])
    assert not left_out[:, moving].any()
    often = left_out[:, ~moving].float().mean(dim=0)
    assert float(often.mean()) == pytest.approx(share, abs=0.02) and float((often - share).abs().max()) < 0.15
    once = shown[0]
    assert set(once.opacities[once.opacities != gaussians.opacities].tolist()) == {0.0}


def test_gaussians_left_out_get_no_gradient():
    torch.manual_seed(1)
    model = untrained_street(settings_of())
    shown = concatenate(with_dropout(model.sample(model.states(0.5)), model, 0.5))
    shown.opacities.sum().backward()
    static = model.parts[0].params["opacities"]
    left_out = shown.opacities[model.rows[0]] == 0.0
    assert left_out.any() and not static.grad[left_out].any() and static.grad[~left_out].all()


@pytest.mark.parametrize(
    ("images", "cameras", "expected"),
    [(0, 1, 0.0), (7, 1, 0.2), (20, 1, 0.2), (40, 1, 0.1), (40, 2, 0.2), (120, 2, 0.2 / 3)],
)
def test_dropout_shrinks_with_the_training_images_of_a_camera(images, cameras, expected):
    """Held-out images, eight more, do not count."""
    names = [f"CAM_{i}" for i in range(cameras)]
    indices = np.arange(images + 8) % cameras
    splits = {"train": np.arange(images), "interpolation": np.arange(images, images + 8)}
    record = training_record_of(images + 8, camera_names=names, camera_indices=indices, splits=splits)
    assert dropout_share(record, settings_of(dropout=0.2)) == pytest.approx(expected)
    assert dropout_share(record, settings_of(dropout=0.0)) == 0.0


def test_a_training_takes_the_share_of_its_scene(tmp_path):
    inputs = inputs_in(tmp_path)
    share = prepare(inputs, job_of(dropout=0.3, dropout_images=1), torch.device("cpu")).settings.dropout
    assert len(inputs.record.train_images) > 1
    assert share == pytest.approx(0.3 / len(inputs.record.train_images))
