"""Preallocated rows: growth into them equals growth without them, and until then they have no effect."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.densification import ALL, a_model, a_view, settings_of, train_step
from helpers.samples import sampled
from helpers.trainings import ALL_TERMS, EndedError, EndingViews, guided_views, trained, untrained_street
from helpers.trainings import settings_of as settings_of_training

from drivesplat.kernels.regularizers import mean_opacity_and_scale
from drivesplat.model.part import active_fraction
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import McmcSettings, RoadSettings, TrainSettings
from drivesplat.training import strategies
from drivesplat.training.densify import Densifier
from drivesplat.training.graphs.captured_steps import IterationGraphs
from drivesplat.training.losses import loss_terms, surface_terms
from drivesplat.training.optimizers import Optimizers, make_optimizers
from drivesplat.training.road import driven_road
from drivesplat.training.schedule import Schedule

SURFACES = {"flatness_weight": 1.0, "road_weight": 1.0}


@pytest.fixture(autouse=True)
def half_at_a_time(monkeypatch):
    monkeypatch.setattr(strategies, "GROWTH", 0.5)


def grown(preallocates: bool, steps: int, **changes: Any) -> tuple[SplatModel, Densifier, Optimizers, list[float]]:
    """A training that grows by half at a time, and the mean opacity and scale after every
    iteration."""
    torch.manual_seed(0)
    growing = {"mcmc": McmcSettings(refine_every=2, noise_lr=0.0), "cap_max": 400}
    model, settings = a_model(), settings_of("mcmc", **{**growing, **changes})
    densifier = Densifier(model.parts[0], Schedule.of(settings, 1), lambda: preallocates)
    (optimizers,) = make_optimizers(model).parts
    means = []
    for step in range(steps):
        train_step(model, densifier, step, optimizers, learns_size=True)
        shown = model.at(0.0)
        opacity, scale = mean_opacity_and_scale((shown.opacities, shown.scales))
        means += [float(mean.detach() / active_fraction(model.parts)) for mean in (opacity, scale)]
    return model, densifier, optimizers, means


def test_preallocated_rows_do_not_change_growth(monkeypatch):
    monkeypatch.setattr(strategies, "explore", lambda *_: None)  # draws for every row, on a CPU
    model, _, _, means = grown(True, 8)
    other, _, _, expected = grown(False, 8)
    part, count = model.parts[0], len(other.parts[0])
    assert (len(part), part.row_count, part.preallocated) == (count, 400, 400 - count) and 300 < count < 400
    for name, values in part.params.items():
        torch.testing.assert_close(values[:count], other.parts[0].params[name], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(means, expected, rtol=1e-3)


def test_preallocated_rows_learn_nothing():
    """Neither by the loss nor by MCMC's noise."""
    noisy = McmcSettings(refine_every=2, noise_lr=5e5)
    model, densifier, optimizers, _ = grown(True, 4, mcmc=noisy)
    part = model.parts[0]
    rows, moved = slice(len(part), None), part.params["means"].detach().clone()
    before = {name: values[rows].detach().clone() for name, values in part.params.items()}
    shown = sampled(part, 0.0)
    assert part.preallocated == 50 and not shown.opacities[rows].any() and not shown.scales[rows].any()
    train_step(model, densifier, 5, optimizers, learns_size=True)
    assert part.preallocated == 50 and not torch.equal(part.params["means"], moved)
    with torch.no_grad():
        preallocated = sampled(part, 0.0)[torch.arange(part.row_count) >= len(part)]
        alone = model.render(a_view(), gaussians=preallocated)
    assert not alone.image.any() and not alone.alpha.any()
    for name, values in part.params.items():
        torch.testing.assert_close(values[rows], before[name], rtol=0, atol=0)
        assert not optimizers[name].state[values]["exp_avg_sq"][rows].any(), name


def test_tensors_keep_their_addresses_while_rows_are_preallocated(monkeypatch):
    monkeypatch.setattr(strategies, "GROWTH", 0.2)
    model, densifier, optimizers, _ = grown(True, 3)
    part = model.parts[0]
    places, counts = {name: values.data_ptr() for name, values in part.params.items()}, [len(part)]
    for step in range(3, 5):
        train_step(model, densifier, step, optimizers)
        counts.append(len(part))
    assert counts[-1] > counts[0] and part.row_count == 200
    assert {name: values.data_ptr() for name, values in part.params.items()} == places


def test_dead_gaussians_are_relocated_and_preallocated_rows_are_not(monkeypatch):
    monkeypatch.setattr(strategies, "GROWTH", 0.05)
    model, densifier, optimizers, _ = grown(True, 3)
    part, count = model.parts[0], len(model)
    with torch.no_grad():
        part.params["opacities"][:30] = -9.0
    densifier.after_step(4, optimizers, {}, ALL)
    opacities = torch.sigmoid(part.params["opacities"])
    assert len(part) == int(1.05 * count) and (opacities[: len(part)] > 0.005).all()
    assert part.preallocated and not opacities[len(part) :].any()


@pytest.mark.parametrize("stops", [True, False])
def test_no_preallocated_row_is_left_when_densification_stops_or_preallocation_is_switched_off(stops):
    """As where a training goes on without a GPU; growth continues then."""
    model, densifier, optimizers, _ = grown(True, 4)
    part, count = model.parts[0], len(model)
    kept = part.params["means"][:count].detach().clone()
    assert part.preallocated
    densifier._strategy.preallocates = lambda: stops
    densifier.after_step(1000 if stops else 4, optimizers, {}, ALL)
    assert part.preallocated == 0 and part.row_count == len(part) == (count if stops else count * 3 // 2)
    assert active_fraction([part]) == 1.0
    if stops:
        torch.testing.assert_close(part.params["means"].detach(), kept)
    train_step(model, densifier, 1001 if stops else 5, optimizers)


def test_preallocated_rows_do_not_change_the_loss():
    """Neither that of images nor those about surfaces, though they lie on the road."""
    model, densifier, optimizers, _ = grown(True, 4)
    part, (view, *_), found = model.parts[0], guided_views(), []
    with torch.no_grad():
        part.params["means"][len(part) :] = torch.tensor([0.0, 0.0, 0.2])
    assert part.preallocated
    road, settings = driven_road(np.tile(np.eye(4), (1, 1, 1)), RoadSettings()), TrainSettings(**SURFACES)
    for _ in range(2):
        with torch.no_grad():
            picture = model.render(view.view)
            terms = loss_terms(picture, view, model, settings), surface_terms(picture.sets, model, road, settings)
        found.append({**terms[0], **terms[1]})
        densifier.end(optimizers)
    assert not part.preallocated and found[0].keys() == found[1].keys() >= {"opacity_reg", "flatness", "road"}
    for name, term in found[0].items():
        assert float(term) == pytest.approx(float(found[1][name])), name


def test_a_training_with_preallocated_rows_resumes_and_leaves_none(tmp_path, monkeypatch):
    """With every term, and actors, of whom new Gaussians have to belong to someone."""
    reserved = []
    monkeypatch.setattr(IterationGraphs, "invalidate", lambda _: not reserved.append(1))
    monkeypatch.setattr(strategies, "GROWTH", 0.2)
    growing = McmcSettings(refine_every=4)
    settings = settings_of_training(iterations=30, checkpoint_every=12, mcmc=growing, refine_start=0.0, **ALL_TERMS)

    def done(name: str, views: list) -> tuple[SplatModel, list[int]]:
        model, summary = trained(tmp_path / name, settings, views, model=untrained_street(settings))
        assert summary.gaussians == len(model)
        return model, summary.resumed_at

    whole, _ = done("whole", guided_views())
    with pytest.raises(EndedError):
        done("it", EndingViews(guided_views(), 20))
    resumed, resumed_at = done("it", guided_views())
    assert len(reserved) >= 4 and resumed_at == [12]
    assert [len(part) for part in resumed.parts] == [len(part) for part in whole.parts]
    assert all(part.preallocated == 0 and part.row_count == len(part) > 50 for part in resumed.parts)
    for name, values in resumed.state_dict().items():
        torch.testing.assert_close(values, whole.state_dict()[name])
