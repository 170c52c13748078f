"""What a run in the closed loop leaves: where everything was at each step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from drivesplat.scene.object_class import ObjectClass

Drivable = Callable[[Float64[np.ndarray, "k 2"]], Bool[np.ndarray, " k"]]
"""Whether places, x and y in world metres, lie on the drivable area."""


@dataclass(frozen=True)
class VehicleShape:
    """The ego vehicle: `length`, `width`, `height`, the `wheelbase`, and how far the body reaches behind the rear axle
    (`rear_overhang`), metres."""

    length: float = 4.6
    width: float = 1.9
    height: float = 1.6
    wheelbase: float = 2.8
    rear_overhang: float = 0.9

    @property
    def centre(self) -> float:
        """How far ahead of the rear axle the middle of the body is, metres."""
        return 0.5 * self.length - self.rear_overhang


@dataclass(frozen=True, eq=False)
class OtherObject:
    """Another object of a run at n steps: its `id`, its class, its `size` (length, width, height in metres), whether it
    is `present`, and its poses, object to world, at the centre of its box (x forward, y left, z up); those of absent
    steps mean nothing."""

    id: str
    object_class: ObjectClass
    size: Float64[np.ndarray, "3"]
    present: Bool[np.ndarray, " n"]
    object_to_world: Float64[np.ndarray, "n 4 4"]

    def velocities(self, seconds: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Velocities in world axes, m/s, by central differences over present steps, one-sided at the ends of a
        presence; 0 where there is one step alone, and at absent steps."""
        places, found = self.object_to_world[:, :3, 3], np.zeros((len(seconds), 3))
        steps = np.flatnonzero(self.present)
        for run in np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1):
            if len(run) > 1:
                found[run] = np.gradient(places[run], seconds[run], axis=0)
        return found


@dataclass(frozen=True, eq=False)
class DrivenRun:
    """A run of n steps.

    `seconds` since the first image, increasing. `ego_to_world` are the poses of the ego vehicle (x forward, y left, z
    up, its origin on the ground below the rear axle), `speed` its signed speed along x (m/s), `steering` the angle of
    its front wheels (radians, to the left). `recorded_seconds` (m,) and `recorded` (m, 4, 4) are the recorded poses of
    the ego vehicle. `drivable` is None where no drivable area is known. `loop_from` is the step from which the policy
    drives: before it the ego vehicle follows the recorded path, and nothing counts.
    """

    seconds: Float64[np.ndarray, " n"]
    ego_to_world: Float64[np.ndarray, "n 4 4"]
    speed: Float64[np.ndarray, " n"]
    steering: Float64[np.ndarray, " n"]
    shape: VehicleShape
    others: Sequence[OtherObject]
    recorded_seconds: Float64[np.ndarray, " m"]
    recorded: Float64[np.ndarray, "m 4 4"]
    drivable: Drivable | None = None
    loop_from: int = 0

    def __len__(self) -> int:
        return len(self.seconds)

    def from_loop(self) -> "DrivenRun":
        """The steps that count: those from `loop_from` on, of which the first has index 0."""
        part = slice(self.loop_from, None)
        others = [
            replace(other, present=other.present[part], object_to_world=other.object_to_world[part])
            for other in self.others
        ]
        return replace(
            self, seconds=self.seconds[part], ego_to_world=self.ego_to_world[part], speed=self.speed[part],
            steering=self.steering[part], others=others, loop_from=0,
        )  # fmt: skip
