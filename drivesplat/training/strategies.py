"""gsplat's densification strategies with a cap, opacity resets, and preallocated rows."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat import MCMCStrategy
from gsplat.strategy import ops
from torch import Tensor
from torch.optim import Adam

from drivesplat.kernels.gsplat_private import HookedDefaultStrategy
from drivesplat.kernels.mcmc import explore
from drivesplat.model.part import Part
from drivesplat.training.graphs.preallocation import activate, release_rows, reserve_rows
from drivesplat.training.schedule import Schedule

GROWTH = 0.05
"""Fraction by which the number of Gaussians grows at each densification step of MCMC, up to the limit."""


class CappedDefaultStrategy(HookedDefaultStrategy):
    """gsplat's DefaultStrategy with at most `cap_max` Gaussians: beyond, only those with the largest gradients grow.

    Resets opacities every `reset_every` iterations, as 3DGS does; gsplat 1.5.3 never does, since its condition
    `step % reset_every == 0 & step > 0` means `... == (0 & step) > 0`.
    """

    cap_max: int = 1_500_000

    def step_post_backward(
        self, params: Any, optimizers: dict[str, Adam], state: dict[str, Any], step: int, info: dict[str, Any]
    ) -> None:
        super().step_post_backward(params, optimizers, state, step, info, packed=False)
        if 0 < step < self.refine_stop_iter and step % self.reset_every == 0:
            ops.reset_opa(params=params, optimizers=optimizers, state=state, value=2.0 * self.prune_opa)

    @torch.no_grad()
    def before_growth(self, state: dict[str, Any]) -> None:
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        allowed = max(0, self.cap_max - len(gradients))
        growing = torch.nonzero(gradients > self.grow_grad2d)[:, 0]
        if len(growing) > allowed:
            smallest_first = growing[torch.argsort(gradients[growing])]
            state["grad2d"][smallest_first[: len(growing) - allowed]] = 0.0


@dataclass
class PreallocatingMcmcStrategy(MCMCStrategy):
    """gsplat's MCMCStrategy for a `part`. It adds noise in one compiled pass and grows by a fraction GROWTH at a time.
    New Gaussians go into preallocated rows where `preallocates`, called whenever there are too few, returns True.
    Unlike gsplat's it does not empty torch's memory cache after every densification."""

    part: Part = field(kw_only=True)
    preallocates: Callable[[], bool] = field(kw_only=True)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Any,
        optimizers: dict[str, Adam],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            state["binoms"] = state["binoms"].to(params["means"].device)
            self.relocate_dead(params, optimizers, state["binoms"])
            self.add_new(params, optimizers, state["binoms"])
        explore(params, lr * self.noise_lr)

    @torch.no_grad()
    def relocate_dead(self, params: Any, optimizers: dict[str, Adam], binoms: Tensor) -> int:
        dead = torch.sigmoid(params["opacities"]) <= self.min_opacity
        dead[len(self.part) :] = False
        count = int(dead.sum())
        if count:
            ops.relocate(params, optimizers, {}, dead, binoms, self.min_opacity)
        return count

    @torch.no_grad()
    def add_new(self, params: Any, optimizers: dict[str, Adam], binoms: Tensor) -> int:
        count = len(self.part)
        more = max(0, min(self.cap_max, int((1.0 + GROWTH) * count)) - count)
        if more > self.part.preallocated:
            if self.preallocates():
                reserve_rows(self.part, optimizers, min(self.cap_max, max(2 * count, count + more)))
            else:
                release_rows(self.part, optimizers)
        if more and self.part.preallocated:
            activate(self.part, more, binoms, self.min_opacity)
        elif more:
            ops.sample_add(params, optimizers, {}, more, binoms, self.min_opacity)
        return more


def make_strategy(
    schedule: Schedule, part: Part, cap_max: int, preallocates: Callable[[], bool]
) -> CappedDefaultStrategy | PreallocatingMcmcStrategy:
    """The strategy that the settings name, for at most `cap_max` Gaussians of a part. With MCMC new Gaussians go into
    preallocated rows where `preallocates` returns True."""
    settings = schedule.settings
    start, stop = map(schedule.step_at, (settings.refine_start, settings.refine_stop))
    if settings.strategy == "mcmc":
        return PreallocatingMcmcStrategy(
            cap_max=cap_max,
            noise_lr=settings.mcmc.noise_lr,
            min_opacity=settings.mcmc.min_opacity,
            refine_start_iter=start,
            refine_stop_iter=stop,
            refine_every=settings.mcmc.refine_every,
            part=part,
            preallocates=preallocates,
        )
    strategy = CappedDefaultStrategy(
        grow_grad2d=settings.default.grow_grad2d,
        prune_opa=settings.default.prune_opacity,
        refine_start_iter=start,
        refine_stop_iter=stop,
        refine_every=settings.default.refine_every,
        reset_every=settings.default.reset_every,
    )
    strategy.cap_max = cap_max
    return strategy
