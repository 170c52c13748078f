"""Densification of a model's parts, each with its own gsplat strategy and state."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import torch
from torch.optim import Adam

from drivesplat.model.part import Part
from drivesplat.training.schedule import Schedule


class Densifier:
    """The densification of one part: call `after_step` at every step. With strategy: mcmc, `preallocates` is
    called before the part's tensors are reallocated; where it returns True, the part gets preallocated rows."""

    def __init__(self, part: Part, schedule: Schedule, preallocates: Callable[[], bool] = lambda: False):
        from drivesplat.kernels.gsplat_private import cpu_strategies  # gsplat; the stage explains where it is missing
        from drivesplat.training import strategies

        settings = schedule.settings
        self._part = part
        self._by_gradient = settings.strategy == "default"
        self._cap = part.cap_max or settings.cap_max
        self._coarse_cap, self._coarse_until = coarse_cap(self._cap, schedule)
        self._strategy = strategies.make_strategy(schedule, part, self._cap, preallocates)
        self._on_cpu = cpu_strategies
        self._dead = 0.0 if self._by_gradient else settings.mcmc.min_opacity
        self._every = settings.default.refine_every if self._by_gradient else settings.mcmc.refine_every
        scale = {"scene_scale": part.extent} if self._by_gradient else {}
        self.state: dict[str, Any] = self._strategy.initialize_state(**scale)

    def due(self, step: int) -> bool:
        """Whether Gaussians may be added, moved or removed after `step`."""
        return step % self._every == 0

    def any_alive(self) -> bool:
        """Whether a Gaussian is left whose opacity is above the threshold of relocation by MCMC."""
        opacities = self._part.params["opacities"]
        return bool(torch.sigmoid(opacities).gt(self._dead).any())

    def after_step(
        self, step: int, optimizers: dict[str, Adam], info: dict[str, Any], rows: slice, coarse: bool = False
    ) -> None:
        """Adds, removes and relocates Gaussians after a step of the optimizers. `rows` are those of the part in the
        rendering; `coarse` says that the image was reduced.

        Uses torch's global random generator, as gsplat does.
        """
        params = self._part.params
        if len(self._part) == 0 or (self.due(step) and not self.any_alive()):
            return  # no Gaussian is left to grow from; other parts of the model may continue
        self._strategy.cap_max = self._coarse_cap if coarse and step < self._coarse_until else self._cap
        if self._by_gradient:
            gradient = info["means2d"].grad  # the strategy reads no more of `means2d`
            info = {**info, "means2d": SimpleNamespace(grad=gradient[:, rows]), "radii": info["radii"][:, rows]}
        extra = {} if self._by_gradient else {"lr": optimizers["means"].param_groups[0]["lr"]}
        with nullcontext() if params["means"].is_cuda else self._on_cpu():
            self._strategy.step_post_backward(params, optimizers, self.state, step, info, **extra)
        if step >= self._strategy.refine_stop_iter:
            self.end(optimizers)

    def end(self, optimizers: dict[str, Adam]) -> None:
        """Drops the preallocated rows that are left."""
        if self._part.preallocated:
            from drivesplat.training.graphs.preallocation import release_rows

            release_rows(self._part, optimizers)


def coarse_cap(cap: int, schedule: Schedule) -> tuple[int, int]:
    """The cap while images are reduced, and the step at which it ends at the latest: early enough to grow to the
    full `cap` before densification stops."""
    from drivesplat.training.strategies import GROWTH

    settings = schedule.settings
    fraction, every = settings.coarse_to_fine.fraction, settings.mcmc.refine_every
    if settings.strategy != "mcmc" or fraction == 1.0:
        return cap, 0
    steps = math.ceil(-math.log(fraction) / math.log1p(GROWTH)) + 1
    return max(1, int(fraction * cap)), schedule.step_at(settings.refine_stop) - steps * every
