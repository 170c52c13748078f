"""Paths along the street. Street frame: metres, x along the road, y to the left, z up, the road at z = 0."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import rigid

LANE_CENTER = 1.75
"""Traffic drives on the right: at y = -LANE_CENTER along x, at +LANE_CENTER against it."""


@dataclass(frozen=True)
class StreetPath:
    """A path from `x`, `y` (metres) at second 0 with `speed` (m/s, negative: against x).

    Speed varies by `surge` (m/s) and y by `sway` (metres), both sinusoidally over `period` seconds. `heading` (radians)
    applies at speed 0. `suspension` adds the pitch, roll and heave of a sprung vehicle while it drives.
    """

    x: float
    y: float
    speed: float = 0.0
    surge: float = 0.0
    sway: float = 0.0
    period: float = 8.0
    heading: float = 0.0
    suspension: bool = False

    def pose_at(self, seconds: float) -> np.ndarray:
        """Object to street (4, 4): on the ground, facing along the path."""
        omega = 2 * math.pi / self.period
        x = self.x + self.speed * seconds + self.surge / omega * (1 - math.cos(omega * seconds))
        y = self.y + self.sway * math.sin(omega * seconds)
        vx = self.speed + self.surge * math.sin(omega * seconds)
        vy = self.sway * omega * math.cos(omega * seconds)
        heading = math.atan2(vy, vx) if self.speed else self.heading
        pose = rigid(Rotation.from_euler("z", heading).as_matrix(), np.array([x, y, 0.0]))
        if self.suspension and self.speed:
            pitch, roll = 0.25 * math.sin(5.1 * seconds), 0.2 * math.sin(3.7 * seconds + 1.0)
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("yx", [pitch, roll], degrees=True).as_matrix()
            pose[2, 3] = 0.012 * math.sin(6.3 * seconds + 0.5)
        return pose


def ego_path(drives: bool) -> StreetPath:
    """The path of the ego vehicle."""
    if drives:
        return StreetPath(0.0, -LANE_CENTER, 8.0, 0.6, 0.12, 9.0, suspension=True)
    return StreetPath(12.0, -LANE_CENTER)


def vehicle_paths(count: int, ego_drives: bool) -> list[StreetPath]:
    """The paths of `count` vehicles: the first drives ahead of the ego vehicle; oncoming ones and further ones ahead
    follow alternately."""
    starts = ((13.0, 8.6), (42.0, 9.2), (70.0, 9.0)) if ego_drives else ((24.0, 4.0), (48.0, 6.0), (76.0, 6.5))
    paths = []
    for i, (x, speed) in enumerate(starts):
        paths.append(StreetPath(x, -LANE_CENTER, speed, 1.2, 0.1, 7.0 + i))
        paths.append(StreetPath(96.0 + 42.0 * i, LANE_CENTER, -(9.0 + 0.7 * i), 0.7, 0.1, 8.0))
    return paths[:count]


def pedestrian_paths(count: int, random: np.random.Generator) -> list[StreetPath]:
    """The paths of `count` pedestrians: alternately along x on the right sidewalk and against x on the left, between
    lamps and trees."""
    paths = []
    for i in range(count):
        side = (-1) ** (i + 1)
        x, y = 22.0 + 13.0 * i + random.uniform(-2, 2), side * random.uniform(7.02, 7.12)
        paths.append(StreetPath(x, y, -side * random.uniform(1.2, 1.6)))
    return paths
