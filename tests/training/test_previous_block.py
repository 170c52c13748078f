"""A training that starts from the trained model of the block before: how both are related, and what it takes over."""

import dataclasses
import logging

import numpy as np
import pytest
import torch
from helpers.records import training_record_of
from helpers.trainings import PROVENANCE, files_in, inputs_in, job_of, same_parameters, untrained_street

from drivesplat.model.checkpoint import TrainedCheckpoint, read_checkpoint, trained_model
from drivesplat.scene.training_record import TrainingRecord, write_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.training.previous_block import PreviousBlock, handover_between, read_previous, start_from
from drivesplat.training.stage import prepare, run_training

SHIFT = np.array([-20.0, 5.0, 0.0])


def block(first: int, end: int, origin: np.ndarray) -> TrainingRecord:
    """Some of the images of a drive along x, 5 m apart, in a world with its `origin` at a place of the drive."""
    poses = np.tile(np.eye(4), (end - first, 1, 1))
    poses[:, 0, 3] = 5.0 * np.arange(first, end)
    poses[:, :3, 3] -= origin
    times = 1_000_000 + 500_000 * np.arange(first, end)
    return training_record_of(end - first, ego_to_world=poses, camtoworlds=poses, timestamps=times)


def test_blocks_are_related_by_the_images_of_both():
    before, here = block(0, 8, np.zeros(3)), block(5, 12, np.array([30.0, 1.0, 0.0]))
    found = handover_between(before, here, 77)
    assert found is not None and found.cap_max == 77
    np.testing.assert_allclose(found.shift, [-30.0, -1.0, 0.0])
    assert found.seconds == pytest.approx(-2.5)
    np.testing.assert_allclose(found.before[5:], found.here[:3])


def test_a_block_without_an_image_of_the_one_before_starts_alone(caplog):
    assert handover_between(block(0, 5, np.zeros(3)), block(5, 9, np.zeros(3)), 1) is None
    job = job_of(("background", "actors"), "mask")
    model, other = untrained_street(job.train), untrained_street(job.train)
    seeds = {name: value.clone() for name, value in model.state_dict().items()}
    previous = PreviousBlock(block(0, 5, np.zeros(3)), TrainedCheckpoint.of(other, job, PROVENANCE))
    with caplog.at_level(logging.WARNING):
        start_from(model, block(5, 9, np.zeros(3)), previous, 500)
    assert "shares no image with the block before it" in caplog.text
    assert all(torch.equal(value, seeds[name]) for name, value in model.state_dict().items())


def moved(record: TrainingRecord) -> TrainingRecord:
    """The same images in a world with another origin."""
    changed = {name: getattr(record, name).copy() for name in ("camtoworlds", "ego_to_world")}
    for poses in changed.values():
        poses[:, :3, 3] += SHIFT
    points = (record.points + SHIFT).astype(np.float32)
    return dataclasses.replace(record, points=points, **changed)


def test_a_training_begins_with_what_the_block_before_has_learned(tmp_path):
    inputs, job, files = inputs_in(tmp_path), job_of(("background",), "mask"), files_in(tmp_path / "before")
    run_training(inputs, job, DeviceSettings(kind="cpu"), files, PROVENANCE, "before")
    write_training_record(tmp_path / "parser.npz", inputs.record)
    previous = read_previous([str(tmp_path / "parser.npz")], [str(files.checkpoint)])
    assert previous is not None and read_previous([], []) is None
    here = dataclasses.replace(inputs, record=moved(inputs.record), previous=previous)
    begun, learned = prepare(here, job, torch.device("cpu")).model, trained_model(read_checkpoint(files.checkpoint))
    visible = torch.sigmoid(learned.parts[0].params["opacities"]) > 0.005
    means = learned.parts[0].params["means"][visible] + torch.from_numpy(SHIFT).float()
    assert len(means) > 20
    torch.testing.assert_close(begun.parts[0].params["means"][: len(means)], means)
    assert torch.equal(begun.sky.params["color"], learned.sky.params["color"])
    alone = prepare(dataclasses.replace(here, previous=None), job, torch.device("cpu")).model
    assert not same_parameters(alone, begun) and not torch.equal(alone.sky.params["color"], begun.sky.params["color"])
    run_training(here, job, DeviceSettings(kind="cpu"), files_in(tmp_path / "here"), PROVENANCE, "here")
    assert len(trained_model(read_checkpoint(tmp_path / "here/checkpoint.npz"))) >= len(means)
