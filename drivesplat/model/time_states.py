"""The tensors that parts of a model depend on at a time, beside their parameters."""

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from drivesplat.trajectories.motion import HALF_STEP

TimeStates = Sequence[Sequence[Tensor]]
"""The time state of each part of a model."""


class ScanTimeStates(NamedTuple):
    """The time states of all parts `now`, and HALF_STEP seconds `before` and `after`: what a scan depends on."""

    now: TimeStates
    before: TimeStates
    after: TimeStates

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors, in a fixed order."""
        return [values for states in self for state in states for values in state]

    def copied(self) -> "ScanTimeStates":
        """A copy in memory of its own."""
        return ScanTimeStates(*([[values.clone() for values in state] for state in states] for states in self))

    @staticmethod
    def times(time: float) -> tuple[float, float, float]:
        """The times of the three states for a scan at a time, in seconds since the first image."""
        return time, time - HALF_STEP, time + HALF_STEP
