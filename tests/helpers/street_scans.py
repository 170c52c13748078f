"""Scans of a street with objects that move: ground, facades and boxes, seen by a LiDAR that spins and drives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivesplat.scene.scan import Scan, ScanRays
from drivesplat.scene.scan_record import NO_OBJECT, RecordedScan
from helpers.drives import to_box
from helpers.records import recorded_scan

HEIGHT, REVOLUTION_S, MAX_RANGE = 1.8, 0.1, 70.0
ELEVATIONS = np.radians(np.linspace(-18.0, 4.0, 24))
STEPS = 480
AZIMUTHS = (np.arange(STEPS) + 0.5) * (2.0 * np.pi / STEPS) - np.pi
OFFSETS = REVOLUTION_S * ((AZIMUTHS + np.pi) / (2.0 * np.pi) - 1.0)


@dataclass(frozen=True)
class Mover:
    """A box of `size` (length, width, height) on the ground: where its centre is at second 0, its velocity, and when it
    starts to move (before, it stands)."""

    place: tuple[float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    size: tuple[float, float, float] = (4.5, 1.8, 1.5)
    starts: float = -100.0

    @property
    def heading(self) -> float:
        return float(np.arctan2(self.velocity[1], self.velocity[0]))

    def at(self, seconds: np.ndarray) -> np.ndarray:
        """The places (n, 2) of its centre."""
        moved = np.maximum(seconds, self.starts) - max(self.starts, 0.0)
        return np.array(self.place) + moved[:, None] * np.array(self.velocity)


WALLS = [Mover((10.0, side), (0.0, 0.0), (120.0, 0.5, 6.0)) for side in (-12.0, 12.0)]
"""Facades along the street, which leads ahead."""


def street_scans(
    movers: Sequence[Mover], seconds: np.ndarray, speed: float = 5.0, seed: int = 0, key_frames_every: int = 5
) -> list[RecordedScan]:
    """Revolutions that end at `seconds`, of a LiDAR that drives ahead from the origin. Ranges have 2 cm of noise."""
    rng = np.random.default_rng(seed)
    return [
        _scan(movers, float(at), speed, rng, number // key_frames_every, number % key_frames_every == 0)
        for number, at in enumerate(seconds)
    ]


def _scan(
    movers: Sequence[Mover], at: float, speed: float, rng: np.random.Generator, sample: int, is_key_frame: bool
) -> RecordedScan:
    shape = (len(ELEVATIONS), STEPS)
    azimuths, offsets = np.broadcast_to(AZIMUTHS, shape), np.broadcast_to(OFFSETS, shape)
    elevations = np.broadcast_to(ELEVATIONS[:, None], shape)
    rays = ScanRays(*(values.astype(np.float32) for values in (azimuths, elevations, offsets)))
    ways = rays.directions().reshape(-1, 3).astype(np.float64)
    times = at + offsets.ravel()
    origins = np.stack([speed * times, np.zeros_like(times), np.full_like(times, HEIGHT)], axis=1)
    ranges = np.where(ways[:, 2] < 0.0, HEIGHT / np.maximum(-ways[:, 2], 1e-9), np.inf)
    met = np.full(len(ranges), NO_OBJECT, dtype=np.int16)
    for number, box in enumerate([*movers, *WALLS]):
        distance = _to_box(box, origins, ways, times)
        nearer = distance < ranges
        ranges[nearer] = distance[nearer]
        met[nearer] = number if number < len(movers) else NO_OBJECT
    returned = ranges < MAX_RANGE
    noisy = np.where(returned, ranges + rng.normal(0.0, 0.02, len(ranges)), 0.0)
    scan = Scan(rays, returned.reshape(shape), noisy.reshape(shape).astype(np.float32))
    pose = np.eye(4)
    pose[:3, 3] = speed * at, 0.0, HEIGHT
    return recorded_scan(
        scan, pose, round(at * 1e6), sample, seconds=at, is_key_frame=is_key_frame, linear=np.array([speed, 0.0, 0.0]),
        objects=np.where(returned, met, NO_OBJECT).reshape(shape).astype(np.int16),
    )  # fmt: skip


def _to_box(box: Mover, origins: np.ndarray, ways: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The distance along each ray to a box; infinite where it misses."""
    cos, sin = np.cos(box.heading), np.sin(box.heading)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    centers = np.column_stack([box.at(times), np.full(len(times), 0.5 * box.size[2])])
    start, along = (origins - centers) @ turn.T, ways @ turn.T
    return to_box(0.5 * np.array(box.size), start, along)
