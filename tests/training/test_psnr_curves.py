"""PSNR curves in TensorBoard: what they show, and that they change no training."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.trainings import (
    CPU,
    HEIGHT,
    PROVENANCE,
    files_in,
    folders_of,
    inputs_in,
    job_of,
    mean_psnr,
    recorded_views,
    same_parameters,
    settings_of,
    untrained,
    untrained_street,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from drivesplat.settings.device import DeviceSettings
from drivesplat.training.loop import train
from drivesplat.training.probes import MAX_IMAGES, curve_psnrs, evenly_spaced
from drivesplat.training.stage import prepare, run_training

pytestmark = pytest.mark.usefixtures("one_thread")


def curves_of(folder) -> dict[str, list[tuple[int, float]]]:
    board = EventAccumulator(str(folder))
    board.Reload()
    names = [name for name in board.Tags()["scalars"] if name.startswith("psnr/")]
    return {name: [(event.step, event.value) for event in board.Scalars(name)] for name in names}


def test_a_training_has_curves_of_training_and_held_out_images(tmp_path):
    """Every eight iterations and after the last of 20."""
    files = files_in(tmp_path / "vanilla")
    job = job_of(psnr_every=8, image_every=15)
    run_training(inputs_in(tmp_path), job, DeviceSettings(kind="cpu"), files, PROVENANCE, "train")
    folder = files.checkpoint.parent / "tensorboard"
    curves = curves_of(folder)
    assert {name: [step for step, _ in points] for name, points in curves.items()} == {
        "psnr/train": [8, 16, 20], "psnr/held_out": [8, 16, 20]
    }  # fmt: skip
    assert curves["psnr/train"][-1][1] > curves["psnr/train"][0][1]
    board = EventAccumulator(str(folder))
    board.Reload()
    assert [event.step for event in board.Images("recorded_and_rendered")] == [15, 20]


@pytest.mark.parametrize("street", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("strategy", ["mcmc", pytest.param("default", marks=pytest.mark.slow)])
def test_curves_change_no_trained_parameter(strategy, street, tmp_path):
    """Bit by bit, with views at times and from places that the training does not have."""
    views, trained = recorded_views(), {}
    elsewhere = [dataclasses.replace(v, view=dataclasses.replace(v.view, time=v.view.time + 0.123)) for v in views]
    for every in (0, 3):
        settings = settings_of(strategy, iterations=30, refine_start=0.0, psnr_every=every)
        model = (untrained_street if street else untrained)(settings)
        curves = {"psnr/held_out": elsewhere}
        folders = folders_of(tmp_path / str(every), "of this training")
        train(model, views, settings, 0, CPU, folders, curves=curves)
        trained[every] = model
        assert len(curves_of(folders.tensorboard).get("psnr/held_out", [])) == (10 if every else 0)
    assert same_parameters(trained[0], trained[3])


def test_held_out_images_are_read_for_the_curves_alone(tmp_path):
    """The third image is held out; without curves nobody reads it."""
    inputs = inputs_in(tmp_path)
    with_curves = prepare(inputs, job_of(), CPU)
    (held_out,) = with_curves.curves["psnr/held_out"]
    assert torch.equal(held_out.pixels, recorded_views()[2].pixels)
    own = {id(view) for view in with_curves.views}
    assert {id(view) for view in with_curves.curves["psnr/train"]} <= own and id(held_out) not in own
    (tmp_path / "images/2.png").unlink()
    assert prepare(inputs, job_of(psnr_every=0), CPU).curves == {}


def test_a_psnr_is_of_all_pixels_outside_the_ego_vehicle():
    views, model = recorded_views(), untrained(settings_of())
    (psnr,) = curve_psnrs(model, {"psnr/train": views[:1], "psnr/none": []}, 1).values()
    assert psnr == pytest.approx(mean_psnr(model, views[:1]), abs=1e-4)
    body = torch.zeros(views[0].pixels.shape[:2], dtype=torch.bool)
    body[HEIGHT // 2 :] = True
    masked = dataclasses.replace(views[0], ego_mask=body)
    with torch.no_grad():
        image = model.render(views[0].view, 1).image.clamp(0.0, 1.0)
    error = (image - views[0].target())[: HEIGHT // 2].square().mean()
    assert curve_psnrs(model, {"x": [masked]}, 1)["x"] == pytest.approx(-10.0 * math.log10(error), abs=1e-4)


def test_few_images_are_spread_over_all():
    assert evenly_spaced([]) == [] and evenly_spaced([7]) == [7] and evenly_spaced([7, 9]) == [7, 9]
    chosen = evenly_spaced(range(100))
    assert len(chosen) == MAX_IMAGES and np.ptp(chosen) == 99
