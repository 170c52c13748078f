"""The Gaussians that an iteration renders: which objects are mirrored."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.trainings import recorded_views, settings_of, untrained_street

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import RollingShutter, View
from drivesplat.settings.train import DeformableSettings
from drivesplat.training.iteration_sets import sets_of_iteration


def street(mirrored: float) -> SplatModel:
    """Background, and two objects that deform."""
    return untrained_street(settings_of(deformable=DeformableSettings(mirrored=mirrored)), people=True)


def one_view(rolling: bool = False) -> View:
    view = recorded_views()[1].view
    shutter = RollingShutter(torch.tensor([0.0, 0.03, 0.0]), torch.zeros(3, 4))
    return dataclasses.replace(view, shutter=shutter) if rolling else view


def are_equal(found: Gaussians, expected: Gaussians) -> bool:
    return all(torch.equal(found.tensors[name], values) for name, values in expected.tensors.items())


@pytest.mark.parametrize("share", [0.2, 0.7])
@pytest.mark.parametrize("looked_up", [True, False])
def test_objects_are_mirrored_at_random(share, looked_up):
    """Each for itself, in its share of the iterations; nothing else changes."""
    torch.manual_seed(0)
    model, view = street(share), one_view()
    states = None if looked_up else model.time_states(view.time)
    recorded = model.sets_in(view)
    shown = [sets_of_iteration(model, view, states, 0.0) for _ in range(300)]
    assert all(are_equal(static, recorded[0]) for static, _ in shown)
    moved = torch.stack([(objects.means - recorded[1].means).norm(dim=1) > 1e-4 for _, objects in shown])
    tracks = [model.parts[1].of_track(track.id) for track in model.parts[1].timeline.tracks]
    often = torch.stack([moved[:, own].any(dim=1) for own in tracks]).double()
    np.testing.assert_allclose(often.mean(dim=1), share, atol=0.08)
    np.testing.assert_allclose((often[0] * often[1]).mean(), share**2, atol=0.08)


def test_without_mirroring_the_gaussians_are_those_of_the_time_and_no_random_number_is_drawn():
    model, view = street(0.0), one_view()
    torch.manual_seed(3)
    first = torch.rand(())
    torch.manual_seed(3)
    for states in (None, model.time_states(view.time)):
        for found, expected in zip(sets_of_iteration(model, view, states, 0.0), model.sets_in(view), strict=True):
            assert are_equal(found, expected)
    assert torch.rand(()) == first


@pytest.mark.parametrize("mirrored", [0.0, 1.0])
def test_a_rolling_shutter_has_the_velocities_of_what_is_shown(mirrored):
    model, view, step = street(mirrored), one_view(rolling=True), 1e-2
    static, objects = sets_of_iteration(model, view, None, 0.0)
    earlier, later = (
        sets_of_iteration(model, dataclasses.replace(view, time=view.time + after), None, 0.0)[1].means.detach()
        for after in (-step, step)
    )
    assert static.velocities is None or not static.velocities.any()
    torch.testing.assert_close(objects.velocities, (later - earlier) / (2.0 * step), atol=0.05, rtol=0.02)
    assert objects.velocities.norm(dim=1).max() > 0.1


def test_dropout_leaves_out_static_gaussians_of_mirrored_models_too():
    torch.manual_seed(0)
    model = street(1.0)
    static, objects = sets_of_iteration(model, one_view(), None, 0.5)
    assert 0.2 < float((static.opacities == 0.0).float().mean()) < 0.8
    assert not (objects.opacities == 0.0).all()
