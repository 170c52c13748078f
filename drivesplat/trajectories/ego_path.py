"""The path of the ego vehicle in an edited drive."""

from collections.abc import Sequence

import numpy as np

from drivesplat.settings.edit import Ego
from drivesplat.trajectories.lateral_offset import PosesAt, offset_poses
from drivesplat.trajectories.transition import Transition


def recorded_time(steps: Sequence[Ego], begin: float, times: np.ndarray) -> np.ndarray:
    """The seconds (n,) of the recorded path at which the edited drive is at film seconds `times` (n,). `begin` is the
    second at which a change without `start` begins."""
    for step in reversed(steps):
        times = Transition.of(step, begin).warp_time(times, step.speed)
    return times


def edited_poses(recorded: PosesAt, steps: Sequence[Ego], begin: float, times: np.ndarray) -> np.ndarray:
    """Ego to world (n, 4, 4) at film seconds `times` (n,); `recorded` maps recorded seconds to ego poses."""
    transitions = [Transition.of(step, -np.inf) for step in steps]
    lateral = sum(step.lateral * t.fraction(times) for step, t in zip(steps, transitions, strict=True))
    lateral_speed = sum(step.lateral * t.rate(times) for step, t in zip(steps, transitions, strict=True))
    return offset_poses(lambda at: recorded(recorded_time(steps, begin, at)), times, lateral, lateral_speed)
