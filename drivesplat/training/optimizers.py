"""Adam for every parameter of a model, one optimizer each, as gsplat's strategies need it; learning rates, and the mean
of the last parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from drivesplat.kernels.optimization import AdamStep, adam_steps
from drivesplat.model.parameters import OFFSETS
from drivesplat.model.splat_model import SplatModel
from drivesplat.training.schedule import Schedule

BETAS, EPS = (0.9, 0.999), 1e-15
DECAY = 0.01
"""Final learning rate of what decays (positions, exposures, deformations, ...), and of all that is fine-tuned, as a
fraction of the initial rate."""
FINE_TUNED_MEANS, FINE_TUNED_OTHERS = 0.5, 6.0
"""Factors of the learning rates at which the fine-tuning of positions, and of all else, begins."""
FINE_TUNED = ("lidar_logits", *OFFSETS.values())
"""The parameters of Gaussians that only the LiDAR sees."""
AVERAGED_EVERY = 5
"""Steps from one whose parameters count in the mean to the next."""


class Adam(torch.optim.Adam):
    """torch.optim.Adam, fused, of one parameter, for `ModelOptimizers`: the same fields and format of state. Its own
    methods avoid torch's, whose first call imports torch's compiler, which takes a second or more. The state and
    `broken` (`adam_steps`) exist from the beginning: a CUDA graph that captured their creation would reset them at
    every replay."""

    def __init__(self, parameter: nn.Parameter, rate: float):
        super().__init__([parameter], lr=rate, betas=BETAS, eps=EPS, fused=True)
        step = torch.zeros((), dtype=torch.float32, device=parameter.device)
        moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
        self.state[parameter] = {"step": step, **moments}
        self.broken = torch.zeros((), device=parameter.device)

    @property
    def parameter(self) -> nn.Parameter:
        (group,) = self.param_groups
        (parameter,) = group["params"]
        return parameter

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        self.param_groups.append({**self.defaults, **param_group})

    def state_dict(self) -> dict[str, Any]:
        groups = [{**group, "params": [0]} for group in self.param_groups]
        return {"state": {0: self.state[self.parameter]}, "param_groups": groups}


Optimizers = dict[str, Adam]


@dataclass
class ModelOptimizers:
    """The optimizers of a model: `parts[i]` for the Gaussians of part i, `shared[i]` for its shared parameters,
    `beside_parts`, by name, for sky and exposure."""

    parts: list[Optimizers]
    shared: list[Optimizers]
    beside_parts: dict[str, Optimizers]

    def all(self) -> list[tuple[str, Adam]]:
        return [
            *((f"{i}.{k}", o) for i, group in enumerate(self.parts) for k, o in group.items()),
            *((f"{i}.shared.{k}", o) for i, group in enumerate(self.shared) for k, o in group.items()),
            *((f"{name}.{k}", o) for name, group in self.beside_parts.items() for k, o in group.items()),
        ]

    @torch.no_grad()
    def step(self, rates: Mapping[str, Tensor] | None = None) -> dict[str, Float[Tensor, ""]]:
        """Steps every optimizer that has a gradient and drops the gradient; with the `rates` in device memory, by name,
        where given. Returns, by name, values that are finite only if the gradients are.

        The same as torch.optim.Adam with `fused`, but parameters share launches: separate steps take Python, and their
        gaps on a GPU, longer than the work.
        """
        ready = {name: optimizer for name, optimizer in self.all() if optimizer.parameter.grad is not None}
        steps = []
        for name, optimizer in ready.items():
            rate = optimizer.param_groups[0]["lr"] if rates is None else rates[name]
            steps.append(AdamStep(optimizer.parameter, optimizer.state[optimizer.parameter], rate, optimizer.broken))
        watched = adam_steps(steps, BETAS, EPS)
        for step in steps:
            step.parameter.grad = None
        return dict(zip(ready, watched, strict=True))


class DeviceSchedule:
    """The values that change with every iteration, in device memory: the step and the learning rates. CUDA graphs read
    them there."""

    def __init__(self, device: torch.device):
        self._device = device
        self._step = torch.zeros((), dtype=torch.int64, device=device)
        self._rates: dict[str, Tensor] = {}
        self._written: dict[str, float] = {}

    def update(
        self, step: int, optimizers: ModelOptimizers
    ) -> tuple[int | Int[Tensor, ""], Mapping[str, Float[Tensor, ""]] | None]:
        """Writes the step and the rates of `optimizers` to the device and returns the tensors, always the same ones. On
        a CPU returns the step itself and None."""
        if self._device.type == "cpu":
            return step, None
        self._step.fill_(step)
        for name, optimizer in optimizers.all():
            rate = optimizer.param_groups[0]["lr"]
            if self._written.get(name) != rate:
                place = self._rates.setdefault(name, torch.zeros((), device=self._device))
                place.fill_(rate)
                self._written[name] = rate
        return self._step, self._rates


def make_optimizers(model: SplatModel) -> ModelOptimizers:
    return ModelOptimizers(
        parts=[_adams(part.params, part.learning_rates()) for part in model.parts],
        shared=[_adams(part.shared, part.learning_rates()) for part in model.parts],
        beside_parts={name: _adams(it.params, it.learning_rates()) for name, it in model.beside_parts.items()},
    )


def _adams(params: nn.ParameterDict, rates: dict[str, float]) -> Optimizers:
    return {
        name: Adam(params[name], rate) for name, rate in rates.items() if name in params and params[name].requires_grad
    }


def choose_learned(optimizers: ModelOptimizers, fine_tunes: bool) -> None:
    """Sets `requires_grad` of the parameters of parts for the next iteration: FINE_TUNED where it `fine_tunes`,
    otherwise all but OFFSETS. Parameters without an optimizer are left alone. What is constant costs no time."""
    for group in (*optimizers.parts, *optimizers.shared):
        for name, optimizer in group.items():
            learned = name in FINE_TUNED if fine_tunes else name not in OFFSETS.values()
            optimizer.parameter.requires_grad_(learned)


def set_learning_rates(model: SplatModel, optimizers: ModelOptimizers, schedule: Schedule, step: int) -> None:
    """Sets the learning rates of a step. Those of exposures and of what parts name in `decaying` decay exponentially,
    and that of exposures is 0 until they start; the others are constant. In steps that fine-tune, the rates of what
    only the LiDAR sees decay anew."""
    if schedule.fine_tunes(step):
        _set_fine_tuning_rates(model, optimizers, schedule.fine_tuned(step))
        return
    done = schedule.progress(step)
    decay = DECAY**done
    for part, *groups in zip(model.parts, optimizers.parts, optimizers.shared, strict=True):
        rates = part.learning_rates()
        for group in groups:
            for name in (name for name in part.decaying if name in group):
                group[name].param_groups[0]["lr"] = rates[name] * decay
    for camera, optimizer in optimizers.beside_parts.get("exposure", {}).items():
        starts = schedule.settings.exposure.start
        rate = model.beside_parts["exposure"].learning_rates()[camera] if done >= starts else 0.0
        optimizer.param_groups[0]["lr"] = rate * decay


def _set_fine_tuning_rates(model: SplatModel, optimizers: ModelOptimizers, done: float) -> None:
    for part, group in zip(model.parts, optimizers.parts, strict=True):
        rates = part.learning_rates()
        for name in FINE_TUNED:
            if name in group:
                begin = FINE_TUNED_MEANS if name == OFFSETS["means"] else FINE_TUNED_OTHERS
                group[name].param_groups[0]["lr"] = rates[name] * begin * DECAY**done


@dataclass
class ParameterAverage:
    """The mean of all parameters over the steps `first` to `last`, of which `count` are in `means` so far: stochastic
    weight averaging (Izmailov et al. 2018, arXiv 1803.05407). Until `last` the number and order of Gaussians may not
    change."""

    first: int
    last: int
    count: int = 0
    means: list[Tensor] = field(default_factory=list)

    @classmethod
    def of(cls, schedule: Schedule) -> "ParameterAverage":
        """Over the last `train.averaged` of the training, after the last densification."""
        settings = schedule.settings
        begin = max(1.0 - settings.averaged, settings.refine_stop) if settings.averaged else 1.0
        return cls(schedule.step_at(begin) + 1, schedule.fine_tuning_from)

    @torch.no_grad()
    def update(self, step: int, model: SplatModel) -> bool:
        """To be called after each step, `step` of which are done. Writes the mean to the model after the last one;
        returns whether it did."""
        if not self.first <= step <= self.last or (self.last - step) % AVERAGED_EVERY:
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
