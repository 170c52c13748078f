"""A step of a training, from top to bottom: sample, render, losses, backward, update.

`drivesplat.training.loop` decides what each step fits. `drivesplat.training.graphs` captures whole steps as CUDA graphs
from outside; therefore a step with the `states` of its time neither looks anything up nor waits for the device.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.road_distance import Road
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, ModelStates, want_of
from drivesplat.training.augmentation import mirrored_at_random, with_dropout
from drivesplat.training.losses import Terms, loss_terms, surface_terms
from drivesplat.training.monitor import FiniteGuard, readable
from drivesplat.training.optimizers import DeviceSchedule, ModelOptimizers, choose_learned, set_learning_rates
from drivesplat.training.scans import TrainingScan, scan_terms
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import TrainingView

ITERATION = "iteration"
"""The stage that holds all others."""


class Clock:
    """What a training tells of the stages of its iterations; this one measures nothing."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """A context for a stage of an iteration; stages follow one another within ITERATION."""
        return nullcontext()


UNTIMED = Clock()


@dataclass
class TrainingState:
    """What steps read and change. `step` is the number of the next one. `device_step` and `rates`, the learning rates
    by optimizer, hold its values for what may be captured (`DeviceSchedule.update`). The `road` is None where it is
    unknown or not wanted."""

    model: SplatModel
    schedule: Schedule
    optimizers: ModelOptimizers
    device_schedule: DeviceSchedule
    guard: FiniteGuard
    road: Road | None
    clock: Clock = UNTIMED
    step: int = 0
    device_step: int | Int[Tensor, ""] = 0
    rates: Mapping[str, Float[Tensor, ""]] | None = None

    @property
    def sh_degree(self) -> int:
        """The degree up to which the next step renders spherical harmonics."""
        return self.schedule.sh_degree(self.step, max(part.sh_degree for part in self.model.parts))

    def begin_step(self) -> None:
        """Sets what the next step learns, and at which rates."""
        choose_learned(self.optimizers, self.schedule.fine_tunes(self.step))
        set_learning_rates(self.model, self.optimizers, self.schedule, self.step)
        self.device_step, self.rates = self.device_schedule.update(self.step, self.optimizers)


def eager_step(state: TrainingState, target: TrainingView | TrainingScan) -> tuple[Terms, Picture | None]:
    """Fits an image or a LiDAR scan. Returns the terms of the loss, without gradients, and the picture of an image."""
    return image_step(state, target) if isinstance(target, TrainingView) else (scan_step(state, target), None)


def image_step(state: TrainingState, image: TrainingView, states: ModelStates | None = None) -> tuple[Terms, Picture]:
    """Fits an image. `states` are those of the parts at its time (None: to be looked up)."""
    model, settings, stage = state.model, state.schedule.settings, state.clock.stage
    by_gradient = settings.strategy == "default"
    model.zero_grad()  # gradients of a step that ran out of memory
    with stage("render"):
        want = want_of(model.seen_from(image.view))
        states = model.states(image.view.time, want) if states is None else states
        sets = model.sample(mirrored_at_random(model, states), want)
        if settings.dropout:
            sets = with_dropout(sets, model, settings.dropout)
        picture = model.render(
            image.view,
            state.sh_degree,
            gaussians=sets,
            with_depth=image.lidar is not None or settings.smoothness_weight > 0,
            with_objects=settings.entropy_weight > 0 and not by_gradient,
        )
    with stage("loss"):
        terms = loss_terms(picture, image, model, settings)
        terms |= surface_terms(picture.sets, model, state.road, settings)
    if by_gradient:
        picture.info["means2d"].retain_grad()
    with stage("backward"):
        torch.stack(list(terms.values())).sum().backward()
    update(state, terms)
    return without_gradients(terms), picture


def scan_step(state: TrainingState, scan: TrainingScan, states: ModelStates | None = None) -> Terms:
    """Fits a LiDAR scan, as `image_step`."""
    model, settings, stage = state.model, state.schedule.settings, state.clock.stage
    model.zero_grad()
    with stage("render"):
        states = model.states(scan.view.time, SCAN) if states is None else states
        nearer = (scan.range - settings.scans.sight_margin).clamp(min=0.0) if settings.scans.sight_weight else None
        picture = model.scan(scan.view, gaussians=model.sample(states, SCAN), before=nearer)
    with stage("loss"):
        terms = scan_terms(picture, scan, model, settings)
        if not state.schedule.images:  # otherwise these belong to the steps that fit images
            terms |= surface_terms(picture.sets, model, state.road, settings)
    with stage("backward"):
        torch.stack(list(terms.values())).sum().backward()
        limit_geometry(model, settings.scans.geometry)
    update(state, terms)
    return without_gradients(terms)


def limit_geometry(model: SplatModel, factor: float) -> None:
    """Multiplies gradients of geometry and of shared parameters by a factor; at 0 there are none. While a training
    fine-tunes, these have no gradients (`choose_learned`)."""
    for part in model.parts:
        for parameter in (*(part.params[name] for name in part.geometry), *part.shared.values()):
            if parameter.grad is not None and factor != 1.0:
                parameter.grad = parameter.grad.mul_(factor) if factor else None


def update(state: TrainingState, terms: Terms) -> None:
    """Steps all optimizers down the gradients, and records whether gradients and terms were finite."""
    with state.clock.stage("optimizer"):
        watched = state.optimizers.step(state.rates)
    with state.clock.stage("checks"):
        losses = {f"loss {name}": value for name, value in terms.items()}
        gradients = {f"gradient of {readable(name, state.model)}": value for name, value in watched.items()}
        state.guard.watch(state.device_step, losses | gradients)


def without_gradients(terms: Terms) -> Terms:
    return {name: value.detach() for name, value in terms.items()}
