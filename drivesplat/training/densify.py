"""The densification of a model's parts: each part its own gsplat strategy and state."""

from contextlib import nullcontext
from typing import Any

import torch

from drivesplat.model.part import Part
from drivesplat.settings.train import TrainSettings
from drivesplat.training.optimizers import Optimizers


class Densifier:
    """The densification of one part: call `before_backward` and `after_step` at every iteration."""

    def __init__(self, part: Part, settings: TrainSettings, scene_scale: float):
        from drivesplat.training import strategies  # gsplat; the stage says in a sentence where it is missing

        self._part = part
        self._by_gradient = settings.strategy == "default"
        self._strategy = strategies.make_strategy(settings)
        self._on_cpu = strategies.torch_twins
        self._dead = 0.0 if self._by_gradient else settings.mcmc.min_opacity
        self._every = settings.default.refine_every if self._by_gradient else settings.mcmc.refine_every
        self.absgrad = self._by_gradient and settings.default.absgrad
        scale = {"scene_scale": scene_scale} if self._by_gradient else {}
        self.state: dict[str, Any] = self._strategy.initialize_state(**scale)

    def due(self, step: int) -> bool:
        """Whether Gaussians may be added, moved or removed after `step`."""
        return step % self._every == 0

    def any_alive(self) -> bool:
        """Whether a Gaussian is left; one that MCMC would relocate for its opacity is not."""
        opacities = self._part.params["opacities"]
        return bool(torch.sigmoid(opacities).gt(self._dead).any())

    def before_backward(self, step: int, optimizers: Optimizers, info: dict[str, Any]) -> None:
        if self._by_gradient:
            self._strategy.step_pre_backward(self._part.params, optimizers, self.state, step, info)

    def after_step(self, step: int, optimizers: Optimizers, info: dict[str, Any]) -> None:
        """Grows, prunes and moves Gaussians after the optimizers have stepped.

        Draws from torch's global generator, as gsplat does.
        """
        params = self._part.params
        extra = {} if self._by_gradient else {"lr": optimizers["means"].param_groups[0]["lr"]}
        with nullcontext() if params["means"].is_cuda else self._on_cpu():
            self._strategy.step_post_backward(params, optimizers, self.state, step, info, **extra)
