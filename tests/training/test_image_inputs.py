"""Shared inputs of captured iterations with images. test_gpu.py tests the graphs, on a GPU."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers.trainings import (
    ALL_TERMS,
    guided_views,
    settings_of,
    untrained_drifting,
    untrained_street,
    without_sky_masks,
)

from drivesplat.kernels.cuda_graphs import CudaGraph
from drivesplat.model.exposure import Exposures
from drivesplat.model.view import RollingShutter
from drivesplat.settings.train import McmcSettings
from drivesplat.training.coarse_to_fine import TrainingImages, reduced
from drivesplat.training.graphs.inputs import SharedImageInputs, can_share
from drivesplat.training.graphs.iteration_graphs import IterationGraphs, Recording
from drivesplat.training.loop import Trainer
from drivesplat.training.losses import depth_loss, loss_terms
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import LidarDepth, TrainingView


def with_depths(view: TrainingView, count: int) -> TrainingView:
    """A view with LiDAR depth at so many pixels; some of the errors are large."""
    rng = np.random.default_rng(count)
    pixels = rng.permutation(view.view.width * view.view.height)[:count]
    depth = np.where(rng.random(count) < 0.1, 50.0, rng.uniform(2.0, 6.0, count))
    return dataclasses.replace(view, lidar=LidarDepth(torch.from_numpy(pixels), torch.from_numpy(depth).float()))


def inputs_for(views: list[TrainingView], by_camera: bool = False) -> SharedImageInputs:
    return SharedImageInputs(TrainingImages(views, Schedule.of(settings_of(), len(views)), 0), by_camera)


@pytest.mark.parametrize(("drifting", "night"), [(False, False), (True, False), (False, True)])
def test_an_iteration_with_shared_inputs_has_the_loss_and_the_gradients_of_its_image(drifting, night):
    """One after the other, in inputs of the same addresses, with different amounts of LiDAR depth."""
    settings = settings_of(**ALL_TERMS)
    model = untrained_drifting(settings) if drifting else untrained_street(settings)
    views = [with_depths(view, count) for view, count in zip(guided_views(), (150, 3, 200, 90, 1), strict=False)]
    views = without_sky_masks(views) if night else views
    shared, addresses = inputs_for(views), set()
    for view in views:
        assert can_share(view)
        inputs = shared.load(view, model.states(view.view.time))
        addresses.add((inputs.number, inputs.image.pixels.data_ptr(), inputs.image.lidar.depth.data_ptr()))
        alone = model.render(view.view, with_depth=True)
        sets = model.sample(inputs.states)
        together = model.render(inputs.view.view, gaussians=sets, with_depth=True)
        expected, found = loss_terms(alone, view, model, settings), loss_terms(together, inputs.view, model, settings)
        assert found.keys() == expected.keys() and {"depth", "horizon" if night else "sky_bce"} <= found.keys()
        torch.testing.assert_close(found, expected)
        pulls = [
            torch.autograd.grad(sum(terms.values()), [part.params["means"] for part in model.parts])
            for terms in (expected, found)
        ]
        torch.testing.assert_close(*pulls)
    assert len(addresses) == 1 and len(views) > 2


@pytest.mark.parametrize("by_camera", [False, True])
def test_images_of_other_shapes_have_inputs_of_their_own_and_those_of_other_cameras_with_exposures(by_camera):
    views = guided_views()
    model = untrained_street(settings_of())
    states = model.states(0.5)
    others = [
        views[0],
        reduced(views[0], 2),
        dataclasses.replace(views[0], sky=None),
        dataclasses.replace(views[0], sky=None, not_sky=views[0].sky),
        dataclasses.replace(views[0], lidar=None),
        dataclasses.replace(views[0], view=dataclasses.replace(views[0].view, camera="CAM_BACK")),
    ]
    shared = inputs_for(views, by_camera)
    assert [shared.load(view, states).number for view in (*others, *others)] == [0, 1, 2, 3, 4, 5 * by_camera] * 2


def test_inputs_do_not_change_the_image_that_they_were_made_of():
    first, second = guided_views()[:2]
    before = first.pixels.clone()
    shared, states = inputs_for([first, second]), untrained_street(settings_of()).states(0.5)
    inputs = shared.load(first, states)
    shared.load(second, states)
    assert torch.equal(first.pixels, before) and torch.equal(inputs.image.pixels, second.pixels)
    torch.testing.assert_close(inputs.view.view.viewmat, second.view.viewmat)


@pytest.mark.parametrize(("count", "room"), [(1, 1), (1, 40), (19, 40), (20, 20), (21, 300), (200, 300)])
def test_the_depth_loss_ignores_unused_entries(count, room):
    rng = np.random.default_rng(room)
    depth = torch.from_numpy(rng.uniform(1.0, 9.0, (20, 30))).float().requires_grad_()
    given = LidarDepth(
        torch.from_numpy(rng.permutation(600)[:count]), torch.from_numpy(rng.uniform(1, 9, count)).float()
    )
    own = LidarDepth(
        torch.cat([given.pixels, torch.full((room - count,), 7)]),
        torch.cat([given.depth, torch.full((room - count,), torch.nan)]),
        torch.tensor(count),
    )
    expected, found = depth_loss(depth, given), depth_loss(depth, own)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(*(torch.autograd.grad(loss, depth)[0] for loss in (expected, found)))


def test_images_whose_graph_serves_no_other_are_not_shared():
    (view, *_) = guided_views()
    assert can_share(view)
    assert not can_share(dataclasses.replace(view, classes=torch.zeros(view.pixels.shape[:2], dtype=torch.uint8)))
    shutter = RollingShutter(torch.tensor([0.0, 0.03, 0.0]), torch.zeros(3, 4))
    assert not can_share(dataclasses.replace(view, view=dataclasses.replace(view.view, shutter=shutter)))


def replayed(monkeypatch: pytest.MonkeyPatch, trainer: Trainer) -> list[Recording]:
    """Has a trainer on a CPU replay iterations: a replay runs what was captured, whatever the trainer passes now.
    Returns what it captures."""
    captured = []

    def capture(graphs: IterationGraphs, recording: Recording, gaussians: float, iteration: Callable) -> CudaGraph:
        captured.append(recording)
        result: dict[str, torch.Tensor] = {}
        none = torch.zeros(0, dtype=torch.int32)
        graph = CudaGraph(lambda: result.update(iteration()), result, none, [], none)
        graphs._graphs[recording] = graph
        return graph

    monkeypatch.setattr(IterationGraphs, "_capture", capture)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    trainer.steps.graphs.enabled = True
    return captured


@pytest.mark.parametrize(("people", "exposed"), [(False, False), (True, False), (False, True)])
def test_replays_train_as_iterations_do(people, exposed, monkeypatch):
    """With images of two cameras, reduced at first: after the first of each kind all iterations are replays."""
    settings = settings_of(**ALL_TERMS, refine_start=1.0, iterations=40, mcmc=McmcSettings(noise_lr=0.0))
    monkeypatch.setattr(TrainingImages, "factor", lambda _, step: 2 if step < 16 else 1)
    views = [with_depths(view, 40 + 30 * i) for i, view in enumerate(guided_views())]
    views[0] = dataclasses.replace(views[0], view=dataclasses.replace(views[0].view, camera="CAM_BACK"))
    losses = []
    for replays in (False, True):
        model = untrained_street(settings, people=people)
        model.exposure = Exposures({"CAM_BACK": torch.full((3,), 0.9)}, settings.exposure) if exposed else None
        trainer = Trainer.begin(model, views, settings, 0, torch.device("cpu"))
        captured = replayed(monkeypatch, trainer) if replays else []
        losses.append([])
        for _ in range(settings.iterations):
            terms = trainer.training_step(with_picture=False)[0]
            losses[-1].append({name: float(value) for name, value in terms.items()})
            trainer.state.step += 1
    sizes, cameras = 2, 1 + exposed
    assert 0 < len(captured) <= sizes * cameras
    for eager, mine in zip(*losses, strict=True):
        assert mine == pytest.approx(eager, rel=1e-3)
    assert sum(losses[0][-1].values()) < sum(losses[0][0].values())


@pytest.mark.parametrize(
    ("cameras", "images", "by_camera", "measured"),
    [(1, 40, True, 8), (6, 40, False, 8), (6, 40, True, 4), (2, 40, True, 4), (3, 2, True, 2), (3, 1, True, 1)],
)
def test_cameras_with_their_own_graphs_share_the_images_that_are_measured(cameras, images, by_camera, measured):
    one = guided_views()[0]
    views = [dataclasses.replace(one.view, camera=f"CAM_{c}") for c in range(cameras) for _ in range(images)]
    shared = inputs_for([dataclasses.replace(one, view=view) for view in views], by_camera)
    assert shared.measured == measured
