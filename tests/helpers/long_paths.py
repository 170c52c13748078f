"""Drives of any path, without files: for what cuts them into blocks and shows these."""

import numpy as np

from drivesplat.scene.scene import Frame, Scene
from helpers.scan_drives import at

STEP_US = 100_000
EVERY = 5
"""Images between key frames, which are at 2 Hz."""


def drive_along(places: np.ndarray, *tracks, stamps: np.ndarray | None = None) -> Scene:
    """A drive with an image at each of `places` (n, 2), 10 times a second, every fifth a key frame."""
    times = np.arange(len(places)) * STEP_US + 1_000_000 if stamps is None else stamps
    frames = tuple(
        Frame("front", int(time), f"{i}.jpg", 16, 9, np.eye(3), at([*place, 1.5]), at([*place, 0.0]), i % EVERY == 0,
              round(i / EVERY), f"image {i}")
        for i, (time, place) in enumerate(zip(times, places, strict=True))
    )  # fmt: skip
    key_frames = np.array([frame.timestamp for frame in frames if frame.is_key_frame])
    return Scene("long", "mine", "", "", np.array([100.0, 200.0, 0.0]), key_frames, frames, (), tracks, "drive", 2.0)


def straight(metres: float, speed: float = 10.0, start: float = 0.0) -> np.ndarray:
    along = np.arange(start, metres, speed * STEP_US * 1e-6)
    return np.stack([along, np.zeros_like(along)], axis=1)
