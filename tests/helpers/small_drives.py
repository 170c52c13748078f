"""Tiny drives of a test's own, as scenes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.preprocess.extract import extract_scene
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.extract import SceneSource
from helpers.tiny_world import CAMERA_AT, CAMERA_TO_EGO, START_US, Thing, World, cast, write_world

HELD_OUT = {"every_nth": 4, "offset": 2, "last_block": 2}
"""Of the tiny drive's 10 key frames: 2, 6; 8, 9."""
TRAINING = (0, 1, 3, 4, 5, 7)
"""The others."""
NOTHING_HELD_OUT = {"every_nth": 0, "last_block": 0}


@dataclass
class Speeding(Thing):
    """A thing that gains speed: `gain` (m/s2)."""

    gain: tuple[float, float] = (0.0, 0.0)

    def at(self, seconds: float) -> np.ndarray:
        return super().at(seconds) + 0.5 * seconds**2 * np.array([*self.gain, 0.0])


def scene_at(root: Path, sweeps: bool = True, **changes) -> Scene:
    """The tiny drive in `root`, with the images between key frames unless told otherwise; `changes` of the source."""
    source = SceneSource(
        dataset="tiny", reader="nuscenes", version="v1.0-mini", scene="0001", frames=None, cameras=("CAM_FRONT",),
        sweeps=sweeps, on_missing="stop",
    )  # fmt: skip
    return extract_scene(source.model_copy(update=changes), root)


def drive(root: Path, *things: Thing, **world) -> Scene:
    """A tiny drive past `things`, written to `root`."""
    return scene_at(write_world(root, World(things=list(things), **world)))


def seconds_of(timestamp: int) -> float:
    """A timestamp as tiny worlds count: from the first key frame."""
    return (timestamp - START_US) * 1e-6


def pixel_rays(world: World, subpixels: int = 1) -> np.ndarray:
    """Rays of depth 1 (h, w, n, 3), in the world's axes, through n = `subpixels`**2 places spread over each pixel."""
    offsets = (np.arange(subpixels) + 0.5) / subpixels - 0.5
    y, x, dy, dx = np.meshgrid(np.arange(world.height), np.arange(world.width), offsets, offsets, indexing="ij")
    pixels = np.stack([x + dx, y + dy, np.ones_like(dx)], axis=-1).reshape(world.height, world.width, -1, 3)
    return pixels @ np.linalg.inv(world.intrinsics).T @ CAMERA_TO_EGO.T


def true_depths(world: World, frame: Frame, subpixels: int = 1) -> np.ndarray:
    """The depth (h, w, n) in metres of what a frame sees in `subpixels`**2 places of each pixel; inf in the sky."""
    seconds, rays = seconds_of(frame.timestamp), pixel_rays(world, subpixels)
    depth, _ = cast(world, world.ego_at(seconds) + CAMERA_AT, rays.reshape(-1, 3), seconds)
    return depth.reshape(rays.shape[:3])


def shows(world: World, frame: Frame, thing: Thing, subpixels: int = 1) -> np.ndarray:
    """Which pixels (h, w) of a frame show a thing at their centre (odd `subpixels`: anywhere), others in the world
    before it or not."""
    alone = World(**{**vars(world), "things": [thing]})
    empty = World(**{**vars(world), "things": []})
    return (true_depths(alone, frame, subpixels) < true_depths(empty, frame, subpixels)).any(axis=2)
