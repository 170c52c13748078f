"""Stops of a training, for measurements of the model as it is then."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from drivesplat.model.splat_model import SplatModel


@dataclass(frozen=True)
class Probes:
    """`count` stops of a training, after equal numbers of iterations, the last one at its end. `see` then gets the
    number of iterations so far, the seconds of training until then, which do not include earlier stops, and the model.
    It must leave the model as it is."""

    count: int
    see: Callable[[int, float, SplatModel], None]

    def due(self, step: int, iterations: int) -> bool:
        """Whether a training of so many iterations stops after its first `step`.

        >>> probes = Probes(4, lambda *_: None)
        >>> [step for step in range(1, 11) if probes.due(step, 10)]
        [3, 5, 8, 10]
        """
        return step * self.count // iterations > (step - 1) * self.count // iterations

    def stop(self, step: int, seconds: float, model: SplatModel) -> float:
        """Shows the model, without gradients. Returns the seconds that this took."""
        began = time.monotonic()
        with torch.no_grad():
            self.see(step, seconds, model)
        return time.monotonic() - began


NO_PROBES = Probes(0, lambda *_: None)
