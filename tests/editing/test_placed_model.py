"""A model with its objects in their places: sampled once for all sensors of a kind, objects known by their index."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from helpers.hand_made_street import AHEAD, straight, street_model

from drivesplat.editing.placed_model import PlacedModel
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.model.view import RollingShutter, View
from drivesplat.rendering.fixed_model import FixedModel

TIME = 1.0
EAST = torch.tensor([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
VIEW = View(torch.tensor([[60.0, 0.0, 48.0], [0.0, 60.0, 27.0], [0.0, 0.0, 1.0]]), EAST, 96, 54, time=TIME)


@pytest.fixture(scope="module")
def model() -> SplatModel:
    return street_model()


def moved(left: float) -> ActorPlacement:
    pose = straight(TIME).copy()
    pose[1, 3] += left
    return ActorPlacement(AHEAD, object_to_world=pose)


def test_objects_are_known_by_the_index_of_their_placement(model):
    placed = PlacedModel(FixedModel(model), TIME, [moved(-3.0), moved(3.0)])
    shown = placed.objects_in(VIEW)
    columns = torch.arange(VIEW.width).expand_as(shown)
    assert shown.dtype == torch.int16 and set(shown.unique().tolist()) == {-1, 0, 1}
    assert columns[shown == 0].float().mean() > columns[shown == 1].float().mean(), "the first is to the right"
    without = PlacedModel(FixedModel(model), TIME, [])
    assert (without.objects_in(VIEW) == -1).all()
    differs = (placed.render(VIEW).image - without.render(VIEW).image).abs().amax(dim=2) > 0.0
    assert differs[shown >= 0].all()


def test_as_recorded_it_renders_what_the_model_does_and_tells_no_objects_apart(model):
    placed = PlacedModel(FixedModel(model), TIME)
    assert torch.equal(placed.render(VIEW).image, model.render(VIEW).image)
    assert torch.equal(placed.surface_depth(VIEW), model.render(VIEW, with_surface_depth=True).surface_depth)
    assert (placed.objects_in(VIEW) == -1).all()
    in_place = PlacedModel(FixedModel(model), TIME, [ActorPlacement(AHEAD)])
    np.testing.assert_allclose(in_place.gaussians_in(VIEW).means, placed.gaussians_in(VIEW).means)


def test_gaussians_are_sampled_once_for_each_kind_of_shutter(model):
    rolling = RollingShutter(torch.tensor([0.0, 0.02, 0.0]), torch.eye(3, 4))
    placed, read_out = PlacedModel(FixedModel(model), TIME, [moved(0.0)]), replace(VIEW, shutter=rolling)
    with patch.object(FixedModel, "sample", autospec=True, side_effect=FixedModel.sample) as sampled:
        for view in (VIEW, VIEW.cropped(0, 0, 48, 54), read_out, read_out):
            placed.render(view)
            placed.objects_in(view)
    assert sampled.call_count == 2
    assert placed.gaussians_in(VIEW).velocities is None and placed.gaussians_in(read_out).velocities is not None
