"""Dropout: which Gaussians an iteration leaves out."""

import pytest
import torch
from helpers.trainings import settings_of, untrained_street

from drivesplat.training.dropout import with_dropout


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_random_share_of_the_static_gaussians_is_left_out(share):
    torch.manual_seed(0)
    model = untrained_street(settings_of())
    gaussians, moving = model.gaussians_at(0.5), model.moving()
    left_out = torch.stack([with_dropout(gaussians, model, share).opacities != gaussians.opacities for _ in range(400)])
    assert not left_out[:, moving].any()
    often = left_out[:, ~moving].float().mean(dim=0)
    assert float(often.mean()) == pytest.approx(share, abs=0.02) and float((often - share).abs().max()) < 0.15
    once = with_dropout(gaussians, model, share)
    assert set(once.opacities[once.opacities != gaussians.opacities].tolist()) == {0.0}


def test_gaussians_left_out_get_no_gradient():
    torch.manual_seed(1)
    model = untrained_street(settings_of())
    gaussians = model.gaussians_at(0.5)
    shown = with_dropout(gaussians, model, 0.5)
    shown.opacities.sum().backward()
    static = model.parts[0].params["opacities"]
    left_out = shown.opacities[model.rows[0]] == 0.0
    assert left_out.any() and not static.grad[left_out].any() and static.grad[~left_out].all()
