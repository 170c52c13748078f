"""Smooth transitions between two states."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly

from drivesplat.settings.edit import Gradual

_FRACTION = BPoly.from_derivatives([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
"""Quintic from 0 to 1 over [0, 1]; first and second derivative are 0 at both ends."""
_RATE, _INTEGRAL = _FRACTION.derivative(), _FRACTION.antiderivative()


@dataclass(frozen=True)
class Transition:
    """A transition from 0 to 1 that starts at `start` and takes `duration`, both in seconds; duration 0 is a step."""

    start: float
    duration: float

    @classmethod
    def of(cls, change: Gradual, default_start: float) -> "Transition":
        """The transition of a change; without a `start` it is a step at `default_start`."""
        if change.start is None:
            return cls(default_start, 0.0)
        return cls(change.start, change.USUAL if change.duration is None else change.duration)

    def fraction(self, times: np.ndarray) -> np.ndarray:
        """The value (n,) in [0, 1] at `times` (n,) in seconds; twice continuously differentiable unless a step."""
        return _FRACTION(self._phase(times)) if self.duration else (times >= self.start).astype(np.float64)

    def rate(self, times: np.ndarray) -> np.ndarray:
        """The derivative (n,) of `fraction` per second; 0 for a step."""
        return _RATE(self._phase(times)) / self.duration if self.duration else np.zeros(len(times))

    def integral(self, times: np.ndarray) -> np.ndarray:
        """The integral (n,) of `fraction` from minus infinity to `times` (n,), in seconds."""
        if not self.duration:
            return np.maximum(times - self.start, 0.0)
        return self.duration * _INTEGRAL(self._phase(times)) + np.maximum(times - self.start - self.duration, 0.0)

    def warp_time(self, times: np.ndarray, factor: float) -> np.ndarray:
        """The time (n,) of a clock whose rate changes from 1 to `factor` over the transition."""
        return times + (factor - 1.0) * self.integral(times)

    def _phase(self, times: np.ndarray) -> np.ndarray:
        return np.clip((times - self.start) / self.duration, 0.0, 1.0)
