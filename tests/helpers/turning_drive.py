"""A vehicle that turns in the tiny world, for fixtures of other datasets: poses, images and returns at any time, in a
world that is turned and tilted against the tiny one."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.scene.rigid import inverse, rigid
from helpers.tiny_world import CAMERA_AT, CAMERA_TO_EGO, SKY, START_US, Thing, World, cast

CAMERA = rigid(CAMERA_TO_EGO @ Rotation.from_euler("xyz", [0.02, -0.03, 0.01]).as_matrix(), CAMERA_AT)
"""Camera to ego."""
SPEED, TURN = 4.0, 0.3
"""Of the vehicle: m/s, rad/s."""
TIMES = START_US + 100_000 * np.arange(6)
"""Of key frames: 10 Hz."""


def things() -> list[Thing]:
    return [
        Thing("car", (4.0, 2.0, 1.6), (10.0, 1.0, 0.8), velocity=(4.2, 0.5), heading=0.12, color=(230, 230, 235)),
        Thing("truck", (6.0, 2.4, 2.6), (16.0, -4.5, 1.3), heading=-0.4, color=(60, 90, 180)),
        Thing("pedestrian", (0.8, 0.6, 1.8), (9.0, 4.0, 0.9), velocity=(1.2, -0.3), heading=2.0, color=(210, 60, 60)),
    ]


@dataclass
class TurningDrive:
    """Poses map to a world of which `to_world` says where the tiny world is in it."""

    to_world: np.ndarray
    world: World = field(default_factory=lambda: World(things=things()))

    def seconds(self, time: float) -> float:
        return (time - START_US) * 1e-6

    def ego(self, time: float) -> np.ndarray:
        """Ego to world (4, 4)."""
        return self.to_world @ self._ego(time)

    def _ego(self, time: float) -> np.ndarray:
        angle = TURN * self.seconds(time)
        place = np.array([np.sin(angle), 1.0 - np.cos(angle), 0.0]) * SPEED / TURN
        return rigid(Rotation.from_euler("z", angle).as_matrix(), place)

    def box(self, thing: Thing, time: float) -> np.ndarray:
        """Object to world (4, 4)."""
        turn = Rotation.from_euler("z", thing.heading).as_matrix()
        return self.to_world @ rigid(turn, thing.at(self.seconds(time)))

    def image(self, time: float) -> np.ndarray:
        """What the camera sees: (h, w, 3) uint8."""
        pose = self._ego(time) @ CAMERA
        x, y = np.meshgrid(np.arange(self.world.width), np.arange(self.world.height))
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(self.world.intrinsics).T @ pose[:3, :3].T
        distance, color = cast(self.world, pose[:3, 3], rays.reshape(-1, 3), self.seconds(time))
        color[~np.isfinite(distance)] = SKY
        return color.reshape(self.world.height, self.world.width, 3).astype(np.uint8)

    def hits(self, scanner: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """The first hits (k, 3) within 70 m of `rays` (n, 3) of a scanner mounted at `scanner` (4, 4), in the world."""
        pose = self._ego(time) @ scanner
        directions = rays @ pose[:3, :3].T
        distance, _ = cast(self.world, pose[:3, 3], directions, self.seconds(time))
        hit = distance < 70.0
        points = pose[:3, 3] + directions[hit] * distance[hit, None]
        return points @ self.to_world[:3, :3].T + self.to_world[:3, 3]


def rays_at(azimuth: float, elevations: np.ndarray) -> np.ndarray:
    """The unit rays (n, 3) of a column of beams."""
    level = np.cos(elevations)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevations)], axis=1)


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (n, 3) in the frame of `pose` (4, 4)."""
    to_frame = inverse(pose)
    return points @ to_frame[:3, :3].T + to_frame[:3, 3]
