"""The mean of a model's parameters over the last iterations of its training: stochastic weight averaging (Izmailov et
al. 2018, arXiv 1803.05407)."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import TrainSettings

EVERY = 5
"""Iterations from one whose parameters count to the next."""


@dataclass
class ParameterAverage:
    """The mean of all parameters over the iterations `first` to `last`, of which `count` are in `means` so far. Until
    `last` the number and order of Gaussians may not change."""

    first: int
    last: int
    count: int = 0
    means: list[Tensor] = field(default_factory=list)

    @classmethod
    def of(cls, settings: TrainSettings) -> "ParameterAverage":
        """Over the last `settings.averaged` of the iterations, after the last densification."""
        begin = max(1.0 - settings.averaged, settings.refine_stop) if settings.averaged else 1.0
        return cls(int(begin * settings.iterations) + 1, settings.iterations)

    @torch.no_grad()
    def update(self, step: int, model: SplatModel) -> bool:
        """To be called after each iteration, `step` of which are done. Writes the mean to the model after the last one;
        returns whether it did."""
        if not self.first <= step <= self.last or (self.last - step) % EVERY:
            return False
        learned = [parameter.data for parameter in model.parameters() if parameter.is_floating_point()]
        self.count += 1
        if self.count == 1:
            self.means = [values.clone() for values in learned]
        else:
            for mean, values in zip(self.means, learned, strict=True):
                mean.lerp_(values, 1.0 / self.count)
        if step < self.last:
            return False
        for mean, values in zip(self.means, learned, strict=True):
            values.copy_(mean)
        self.means = []
        return True

    def state(self) -> dict[str, Any]:
        """What a resumed training needs of it."""
        return {"count": self.count, "means": self.means}

    def restore(self, state: dict[str, Any], device: torch.device) -> None:
        """The inverse of `state`."""
        self.count, self.means = state["count"], [values.to(device) for values in state["means"]]
