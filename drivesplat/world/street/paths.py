"""Paths of objects along the road: poses and the distance travelled, at any time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.world.street.road import STRAIGHT, ReferenceLine

LANE_CENTER = 1.75
"""Traffic drives on the right: at t = -LANE_CENTER along s, at +LANE_CENTER against it."""
SUSPENSION = ((0.25, 5.1, 0.0), (0.2, 3.7, 1.0), (0.012, 6.3, 0.0))
"""Amplitude (degrees, degrees, metres), angular frequency (1/s) and phase of pitch, roll and heave."""


@runtime_checkable
class ObjectPath(Protocol):
    """The motion of an object."""

    @property
    def moves(self) -> bool:
        """Whether the pose changes with time."""

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        """Object to street (n, 4, 4): on the ground, facing along the path."""

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        """Metres travelled since second 0 (n,)."""


@dataclass(frozen=True)
class StreetPath:
    """A path from `s`, `t` (metres, road coordinates) at second 0 with `speed` (m/s, negative: against s).

    Speed varies by `surge` (m/s) and t by `sway` (metres), both sinusoidally over `period` seconds. At speed 0 the
    object faces `heading` (radians to the left of the road) and turns by +-`turning` radians over the same period.
    `suspension` adds the pitch, roll and heave of a sprung vehicle while it drives.
    """

    s: float
    t: float
    speed: float = 0.0
    surge: float = 0.0
    sway: float = 0.0
    period: float = 8.0
    heading: float = 0.0
    turning: float = 0.0
    suspension: bool = False
    road: ReferenceLine = STRAIGHT

    @property
    def moves(self) -> bool:
        return self.speed != 0.0 or self.turning != 0.0

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        phase = self._omega * seconds
        t = self.t + self.sway * np.sin(phase)
        if self.speed:
            forward, left = self.speed + self.surge * np.sin(phase), self.sway * self._omega * np.cos(phase)
            # where the object comes to rest the direction stays that of its drive
            yaw = np.arctan2(left, np.where(np.abs(forward) < 1e-3, self.speed, forward))
        else:
            yaw = self.heading + self.turning * np.sin(phase)
        poses = self.road.poses(self.along(seconds), t, yaw)
        return sprung(poses, seconds) if self.suspension and self.speed else poses

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        return np.abs(self.along(seconds) - self.s)

    @property
    def _omega(self) -> float:
        return 2 * np.pi / self.period

    def along(self, seconds: np.ndarray) -> np.ndarray:
        """Road coordinate s (n,) in metres."""
        surge = self.surge / self._omega * (1 - np.cos(self._omega * seconds))
        return self.s + self.speed * seconds + surge


def sprung(poses: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) of a vehicle at `seconds` (n,) with the pitch, roll and heave of its suspension; changes them in
    place."""
    pitch, roll, heave = (a * np.sin(w * seconds + p) for a, w, p in SUSPENSION)
    turned = Rotation.from_euler("xy", np.stack([roll, pitch], axis=-1), degrees=True).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ turned
    poses[:, 2, 3] += heave
    return poses


@dataclass(frozen=True)
class GivenPath:
    """A path of given poses: `poses_at` maps seconds (n,) to object to street (n, 4, 4)."""

    poses_at: Callable[[np.ndarray], np.ndarray]
    moves: bool = True

    def poses(self, seconds: np.ndarray) -> np.ndarray:
        return self.poses_at(seconds)

    def distance(self, seconds: np.ndarray) -> np.ndarray:
        times = np.linspace(0.0, max(float(seconds.max(initial=0.0)), 1e-3), 200)
        steps = np.linalg.norm(np.diff(self.poses_at(times)[:, :2, 3], axis=0), axis=1)
        return np.interp(seconds, times, np.concatenate([[0.0], np.cumsum(steps)]))
