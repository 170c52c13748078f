"""The densification of a model's parts: each part its own gsplat strategy and state."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import torch

from drivesplat.model.part import Part
from drivesplat.settings.train import TrainSettings
from drivesplat.training.optimizers import Optimizers


class Densifier:
    """The densification of one part: call `after_step` at every iteration. With strategy: mcmc, `preallocates` is
    called before the part's tensors are reallocated; where it returns True, the part gets preallocated rows."""

    def __init__(self, part: Part, settings: TrainSettings, preallocates: Callable[[], bool] = lambda: False):
        from drivesplat.kernels.gsplat_private import cpu_strategies  # gsplat; the stage explains where it is missing
        from drivesplat.training import strategies

        self._part = part
        self._by_gradient = settings.strategy == "default"
        self._cap = part.cap_max or settings.cap_max
        self._few, self._few_until = few_at_first(self._cap, settings)
        self._strategy = strategies.make_strategy(settings, part, self._cap, preallocates)
        self._on_cpu = cpu_strategies
        self._dead = 0.0 if self._by_gradient else settings.mcmc.min_opacity
        self._every = settings.default.refine_every if self._by_gradient else settings.mcmc.refine_every
        scale = {"scene_scale": part.extent} if self._by_gradient else {}
        self.state: dict[str, Any] = self._strategy.initialize_state(**scale)

    def due(self, step: int) -> bool:
        """Whether Gaussians may be added, moved or removed after `step`."""
        return step % self._every == 0

    def _room(self, step: int, coarse: bool) -> int:
        """How many there may be after `step`, in which images were `coarse` or whole."""
        return self._few if coarse and step < self._few_until else self._cap

    def any_alive(self) -> bool:
        """Whether a Gaussian is left; one that MCMC would relocate for its opacity is not."""
        opacities = self._part.params["opacities"]
        return bool(torch.sigmoid(opacities).gt(self._dead).any())

    def after_step(
        self, step: int, optimizers: Optimizers, info: dict[str, Any], rows: slice, coarse: bool = False
    ) -> None:
        """Grows, prunes and moves Gaussians after the optimizers have stepped; `rows` of what was rendered, `coarse` or
        whole, are theirs.

        Draws from torch's global generator, as gsplat does.
        """
        params = self._part.params
        if len(self._part) == 0 or (self.due(step) and not self.any_alive()):
            return  # nothing is left to grow from; the model's other parts may go on
        self._strategy.cap_max = self._room(step, coarse)
        if self._by_gradient:
            info = _own(info, rows)
        extra = {} if self._by_gradient else {"lr": optimizers["means"].param_groups[0]["lr"]}
        with nullcontext() if params["means"].is_cuda else self._on_cpu():
            self._strategy.step_post_backward(params, optimizers, self.state, step, info, **extra)
        if step >= self._strategy.refine_stop_iter:
            self.end(optimizers)

    def end(self, optimizers: Optimizers) -> None:
        """Drops the preallocated rows that are left."""
        if self._part.preallocated:
            from drivesplat.training.cuda_graph.preallocation import release_rows

            release_rows(self._part, optimizers)


def few_at_first(cap: int, settings: TrainSettings) -> tuple[int, int]:
    """How many of `cap` Gaussians there may be while images are reduced, and until which iteration: late enough for
    them to grow to all of them before densification stops."""
    share, mcmc = settings.coarse_to_fine.share, settings.mcmc
    if settings.strategy != "mcmc" or share == 1.0 or mcmc.growth == 0.0:
        return cap, 0
    times = math.ceil(-math.log(share) / math.log1p(mcmc.growth)) + 1
    return max(1, int(share * cap)), int(settings.refine_stop * settings.iterations) - times * mcmc.refine_every


def _own(info: dict[str, Any], rows: slice) -> dict[str, Any]:
    """What a rendering tells gsplat's DefaultStrategy about some of its Gaussians."""
    means2d = info["means2d"]
    gradients = {name: getattr(means2d, name, None) for name in ("grad", "absgrad")}
    own = {name: values[:, rows] for name, values in gradients.items() if values is not None}
    return {**info, "means2d": SimpleNamespace(**own), "radii": info["radii"][:, rows]}
