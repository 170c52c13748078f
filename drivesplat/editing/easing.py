"""Changes that come in smoothly."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly

from drivesplat.settings.edit import Gradual

_SHARE = BPoly.from_derivatives([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
"""From 0 to 1 over [0, 1], first and second derivative 0 at both ends."""
_RATE, _AREA = _SHARE.derivative(), _SHARE.antiderivative()


@dataclass(frozen=True)
class Onset:
    """A change that begins at second `start` and is whole `duration` seconds later."""

    start: float
    duration: float

    @classmethod
    def of(cls, change: Gradual, beginning: float) -> "Onset":
        """When a change comes in; one without a start jumps in at second `beginning`."""
        if change.start is None:
            return cls(beginning, 0.0)
        return cls(change.start, change.USUAL if change.duration is None else change.duration)

    def share(self, at: np.ndarray) -> np.ndarray:
        """How much of the change has come in at the seconds `at` (n,): (n,) in [0, 1], twice differentiable."""
        return _SHARE(self._passed(at)) if self.duration else (at >= self.start).astype(np.float64)

    def rate(self, at: np.ndarray) -> np.ndarray:
        """The derivative (n,) of `share`, per second; of a jump 0."""
        return _RATE(self._passed(at)) / self.duration if self.duration else np.zeros(len(at))

    def elapsed(self, at: np.ndarray) -> np.ndarray:
        """The integral (n,) of `share` up to the seconds `at` (n,): seconds."""
        if not self.duration:
            return np.maximum(at - self.start, 0.0)
        return self.duration * _AREA(self._passed(at)) + np.maximum(at - self.start - self.duration, 0.0)

    def paced(self, at: np.ndarray, factor: float) -> np.ndarray:
        """What a clock shows (n,) at the seconds `at` (n,) that comes to run `factor` times as fast."""
        return at + (factor - 1.0) * self.elapsed(at)

    def _passed(self, at: np.ndarray) -> np.ndarray:
        return np.clip((at - self.start) / self.duration, 0.0, 1.0)
