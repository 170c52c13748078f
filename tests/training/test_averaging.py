"""The mean of parameters over the last iterations."""

import pytest
import torch
from helpers.trainings import (
    EndedError,
    EndingViews,
    guided_views,
    recorded_views,
    same_parameters,
    settings_of,
    trained,
    untrained,
    untrained_street,
)

from drivesplat.settings.train_geometry import FloaterSettings
from drivesplat.training.loop import TrainingRun
from drivesplat.training.optimizers import AVERAGED_EVERY, ParameterAverage
from drivesplat.training.schedule import Schedule


def averages(monkeypatch) -> list[dict[str, torch.Tensor]]:
    """The parameters of a model when each iteration of later trainings ends, before a mean is written."""
    recorded, update = [], ParameterAverage.update

    def recording(average, step, model):
        recorded.append({name: value.detach().clone() for name, value in model.named_parameters()})
        return update(average, step, model)

    monkeypatch.setattr(ParameterAverage, "update", recording)
    return recorded


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_ends_with_the_mean_of_its_last_parameters(strategy, monkeypatch, tmp_path):
    """Of 60 iterations every fifth of the last 30: densification ends with the 24th. Owners of Gaussians stay."""
    recorded, settings = averages(monkeypatch), settings_of(strategy, refine_stop=0.4, averaged=0.5)
    model, _ = trained(tmp_path, settings, guided_views(), model=untrained_street(settings))
    assert len(recorded) == 60
    last = recorded[30 + AVERAGED_EVERY - 1 :: AVERAGED_EVERY]
    for name, value in model.named_parameters():
        if value.is_floating_point():
            expected = torch.stack([each[name] for each in last]).mean(dim=0)
            torch.testing.assert_close(value.detach(), expected, atol=1e-5, rtol=1e-4)
        else:
            assert torch.equal(value, recorded[-1][name])
    assert not same_as(recorded[-1], dict(model.named_parameters()))


def same_as(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize(("share", "refine_stop"), [(0.0, 0.4), (0.5, 1.0)])
def test_there_is_no_mean_where_none_is_wanted_or_densification_never_ends(share, refine_stop, monkeypatch, tmp_path):
    recorded, settings = averages(monkeypatch), settings_of(averaged=share, refine_stop=refine_stop)
    model, _ = trained(tmp_path, settings)
    assert same_as(recorded[-1], dict(model.named_parameters()))


@pytest.mark.parametrize(("share", "first"), [(0.1, 6_301), (0.3, 5_832), (1.0, 5_832)])
def test_the_mean_begins_after_the_last_densification(share, first):
    average = ParameterAverage.of(Schedule.of(settings_of(iterations=7_000, refine_stop=0.833, averaged=share), 1))
    assert (average.first, average.last) == (first, 7_000)


def test_a_training_that_ends_within_the_mean_resumes_as_the_same_training(tmp_path):
    settings = settings_of(refine_stop=0.2, averaged=0.75)
    whole, _ = trained(tmp_path / "whole", settings)
    with pytest.raises(EndedError):
        trained(tmp_path / "it", settings, EndingViews(recorded_views(), 43))
    resumed, summary = trained(tmp_path / "it", settings)
    assert summary.resumed_at == [30]
    assert same_parameters(resumed, whole)


def test_gaussians_in_empty_space_are_faded_in_the_mean_too(monkeypatch, tmp_path):
    """As if a mean had restored all: cameras drove from x = -1 to 1."""

    def opaque(average, step, model):
        if step == average.last:
            model.parts[0].params["opacities"].data.fill_(3.0)
        return step == average.last

    monkeypatch.setattr(ParameterAverage, "update", opaque)
    settings = settings_of(floaters=FloaterSettings(radius=4.5, every=100))
    model, _ = trained(tmp_path, settings, model=untrained(settings))
    opacities, near = model.parts[0].params["opacities"], model.parts[0].params["means"].norm(dim=1) < 4.0
    assert near.any() and (opacities[near] < 0.0).all() and (opacities == 3.0).any()


def test_curves_of_psnr_end_with_the_mean(monkeypatch, tmp_path):
    """The model that is evaluated, not that before the mean was written."""
    recorded, seen = averages(monkeypatch), []
    psnrs = TrainingRun.psnrs

    def watching(run):
        seen.append({name: value.detach().clone() for name, value in run.trainer.state.model.named_parameters()})
        return psnrs(run)

    monkeypatch.setattr(TrainingRun, "psnrs", watching)
    model, _ = trained(tmp_path, settings_of(averaged=0.1))
    assert same_as(seen[-1], dict(model.named_parameters())) and not same_as(recorded[-1], seen[-1])
