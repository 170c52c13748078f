"""The course of the road: straight, or with a bend and a slope.

Road coordinates: `s` metres along the centre line, `t` metres to its left, `h` metres above the road. Street frame:
metres, x along the road at s = 0, y to the left, z up.
"""

from dataclasses import dataclass, replace

import numpy as np

from drivesplat.world.shapes.mesh import ColoredMesh
from drivesplat.world.shapes.vectors import cross

VERTICAL_CURVE = 30.0
"""Length in metres over which the slope changes from level to its grade."""


@dataclass(frozen=True)
class ReferenceLine:
    """A road that is straight up to `bend_start`, an arc of `radius` for `bend_length`, and straight again; it rises at
    `grade` from `rise_start` to `rise_end`. Metres; a positive radius bends to the left, an infinite one is straight.
    """

    bend_start: float = 0.0
    bend_length: float = 0.0
    radius: float = np.inf
    grade: float = 0.0
    rise_start: float = 0.0
    rise_end: float = 0.0

    @property
    def is_straight(self) -> bool:
        """Whether road coordinates are those of the street."""
        return not np.isfinite(self.radius) and self.grade == 0.0

    def heading(self, s: np.ndarray) -> np.ndarray:
        """Direction (n,) of the centre line in radians to the left of the x axis."""
        return np.clip(s - self.bend_start, 0.0, self.bend_length) / self.radius

    def slope(self, s: np.ndarray) -> np.ndarray:
        """Height gained per metre (n,)."""
        return self.grade * (self._ramp(s - self.rise_start) - self._ramp(s - self.rise_end))

    def elevation(self, s: np.ndarray) -> np.ndarray:
        """Height (n,) of the road in metres: the integral of the slope."""
        return self.grade * (self._ramp_integral(s - self.rise_start) - self._ramp_integral(s - self.rise_end))

    def center(self, s: np.ndarray) -> np.ndarray:
        """Points (n, 3) of the centre line in the street frame."""
        before, along = np.minimum(s, self.bend_start), np.clip(s - self.bend_start, 0.0, self.bend_length)
        after, angle = np.maximum(s - self.bend_start - self.bend_length, 0.0), self.heading(s)
        # the chord of an arc: length * sinc(angle / 2) in the direction of half the angle
        chord = along * np.sinc(angle / (2 * np.pi))
        x = before + chord * np.cos(angle / 2) + after * np.cos(angle)
        y = chord * np.sin(angle / 2) + after * np.sin(angle)
        return np.stack([x, y, self.elevation(s)], axis=-1)

    def points(self, places: np.ndarray) -> np.ndarray:
        """Points (n, 3) in road coordinates s, t, h as points in the street frame."""
        s, t, h = np.moveaxis(np.asarray(places, dtype=np.float64), -1, 0)
        heading, points = self.heading(s), self.center(s)
        points[..., 0] -= t * np.sin(heading)
        points[..., 1] += t * np.cos(heading)
        points[..., 2] += h
        return points

    def poses(self, s: np.ndarray, t: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Poses (n, 4, 4), object to street, of objects on the road at `s`, `t` (n,), turned by `yaw` (n,) radians to
        the left of the centre line. They stand on the road and tilt with its slope."""
        heading, slope = self.heading(s), self.slope(s)
        up = np.stack([-slope * np.cos(heading), -slope * np.sin(heading), np.ones_like(slope)], axis=-1)
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        forward = np.stack([np.cos(heading + yaw), np.sin(heading + yaw), np.zeros_like(heading)], axis=-1)
        left = cross(up, forward)
        left /= np.linalg.norm(left, axis=-1, keepdims=True)
        poses = np.tile(np.eye(4), (len(s), 1, 1))
        poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = cross(left, up), left, up
        poses[:, :3, 3] = self.points(np.stack([s, t, np.zeros_like(s)], axis=-1))
        return poses

    def follow(self, mesh: ColoredMesh) -> ColoredMesh:
        """A mesh in road coordinates as one in the street frame: every vertex follows the road."""
        return mesh if self.is_straight else replace(mesh, vertices=self.points(mesh.vertices))

    def place(self, mesh: ColoredMesh, s: float, t: float = 0.0) -> ColoredMesh:
        """A mesh given relative to the place `s`, `t`, upright in the street frame and aligned with the road there."""
        if self.is_straight:
            return mesh.moved((s, t, 0.0))
        position = self.points(np.array([[s, t, 0.0]]))[0]
        return mesh.moved(position, float(self.heading(np.array([s]))[0]))

    @staticmethod
    def _ramp(past: np.ndarray) -> np.ndarray:
        return np.clip(past / VERTICAL_CURVE, 0.0, 1.0)

    @staticmethod
    def _ramp_integral(past: np.ndarray) -> np.ndarray:
        within = np.clip(past, 0.0, VERTICAL_CURVE)
        return within**2 / (2 * VERTICAL_CURVE) + np.maximum(past - VERTICAL_CURVE, 0.0)


STRAIGHT = ReferenceLine()
