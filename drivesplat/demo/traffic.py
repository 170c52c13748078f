"""Who moves how along the street. Street frame: metres, x along the road, y to the left, z up, the road at z = 0."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid

LANE_CENTER = 1.75
"""Traffic drives on the right: at y = -LANE_CENTER along x, at +LANE_CENTER against it."""


@dataclass(frozen=True)
class StreetMotion:
    """A way along the street: at `x`, `y` (metres) at second 0 with `speed` (m/s, negative: against x).

    The speed swings by `surge` (m/s) and the way sways sideways by `sway` (metres), both over `period` seconds.
    `heading` (radians) is that of what stands.
    """

    x: float
    y: float
    speed: float = 0.0
    surge: float = 0.0
    sway: float = 0.0
    period: float = 8.0
    heading: float = 0.0

    def pose_at(self, seconds: float) -> np.ndarray:
        """Object to street (4, 4): on the ground, heading along the way."""
        omega = 2 * math.pi / self.period
        x = self.x + self.speed * seconds + self.surge / omega * (1 - math.cos(omega * seconds))
        y = self.y + self.sway * math.sin(omega * seconds)
        vx = self.speed + self.surge * math.sin(omega * seconds)
        vy = self.sway * omega * math.cos(omega * seconds)
        heading = math.atan2(vy, vx) if self.speed else self.heading
        return rigid(Rotation.from_euler("z", heading).as_matrix(), np.array([x, y, 0.0]))


@dataclass(frozen=True)
class SprungMotion(StreetMotion):
    """A way with the pitch, roll and heave of springs while the car drives."""

    def pose_at(self, seconds: float) -> np.ndarray:
        """Ego to street (4, 4)."""
        pose = super().pose_at(seconds)
        if self.speed:
            pitch, roll = 0.25 * math.sin(5.1 * seconds), 0.2 * math.sin(3.7 * seconds + 1.0)
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("yx", [pitch, roll], degrees=True).as_matrix()
            pose[2, 3] = 0.012 * math.sin(6.3 * seconds + 0.5)
        return pose


def ego_motion(drives: bool) -> StreetMotion:
    """The own car's way."""
    return SprungMotion(0.0, -LANE_CENTER, 8.0, 0.6, 0.12, 9.0) if drives else SprungMotion(12.0, -LANE_CENTER)


def vehicle_motions(count: int, ego_drives: bool) -> list[StreetMotion]:
    """The ways of `count` vehicles: the first leads the own car, then oncoming and further leading ones by turns."""
    starts = ((13.0, 8.6), (42.0, 9.2), (70.0, 9.0)) if ego_drives else ((24.0, 4.0), (48.0, 6.0), (76.0, 6.5))
    leading = [StreetMotion(x, -LANE_CENTER, speed, 1.2, 0.1, 7.0 + i) for i, (x, speed) in enumerate(starts)]
    oncoming = [StreetMotion(96.0 + 42.0 * i, LANE_CENTER, -(9.0 + 0.7 * i), 0.7, 0.1, 8.0) for i in range(3)]
    by_turns = [motion for pair in zip(leading, oncoming, strict=True) for motion in pair]
    return by_turns[:count]


def pedestrian_motions(count: int, random: np.random.Generator) -> list[StreetMotion]:
    """The ways of `count` people: along x on the right sidewalk, against it on the left, by turns,
    between lamps and trees."""
    motions = []
    for i in range(count):
        side = (-1) ** (i + 1)
        x, y = 22.0 + 13.0 * i + random.uniform(-2, 2), side * random.uniform(7.02, 7.12)
        motions.append(StreetMotion(x, y, -side * random.uniform(1.2, 1.6)))
    return motions
