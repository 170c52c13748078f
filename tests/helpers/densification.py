"""A model and a view on which densification is tried."""

import math
from typing import Any

import numpy as np
import torch

from drivesplat.kernels.regularizers import mean_opacity_and_scale
from drivesplat.model.background import Background
from drivesplat.model.part import active_fraction
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.settings.train import DefaultSettings, GaussianSettings, McmcSettings, TrainSettings
from drivesplat.training.densify import Densifier
from drivesplat.training.optimizers import Optimizers

ALL = slice(None)
"""The rows of a lone part."""


def a_model(count: int = 100, size: float = 0.05) -> SplatModel:
    """Small Gaussians spread before the camera of `a_view`."""
    rng = np.random.default_rng(0)
    positions, colors = rng.uniform([-2, -1.5, 3], [2, 1.5, 5], (count, 3)), rng.uniform(0, 1, (count, 3))
    part = Background.from_points(positions, colors, GaussianSettings(sh_degree=1), 1.0)
    part.params["scales"].data.fill_(math.log(size))
    return SplatModel([part], None)


def a_view() -> View:
    intrinsics = torch.tensor([[24.0, 0.0, 16.0], [0.0, 24.0, 12.0], [0.0, 0.0, 1.0]])
    return View(intrinsics, torch.eye(4), 32, 24, 0.0)


def settings_of(strategy: str, **changes: Any) -> TrainSettings:
    """Densification at every second iteration of a thousand."""
    common = {
        "iterations": 1000, "strategy": strategy, "refine_start": 0.0, "refine_stop": 1.0,
        "mcmc": McmcSettings(refine_every=2, noise_lr=0.0),
        "default": DefaultSettings(refine_every=2, prune_opacity=1e-3),
    }  # fmt: skip
    return TrainSettings(**{**common, **changes})


def train_step(
    model: SplatModel, densifier: Densifier, step: int, optimizers: Optimizers, coarse: bool = False,
    learns_size: bool = False,
) -> None:  # fmt: skip
    """An iteration towards a random image, and towards less opacity and size, as the trainer makes it."""
    target = torch.from_numpy(np.random.default_rng(1).uniform(0, 1, (24, 32, 3))).float()
    picture = model.render(a_view(), 1)
    picture.info["means2d"].retain_grad()
    loss = (picture.image - target).abs().mean()
    if learns_size:
        means = mean_opacity_and_scale((picture.shapes.opacities, picture.shapes.scales))
        loss = loss + 0.1 * sum(means) / active_fraction(model.parts)
    loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    densifier.after_step(step, optimizers, picture.info, model.rows[0], coarse)
