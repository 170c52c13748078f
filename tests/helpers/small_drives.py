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


def depths_at(world: World, frame: Frame, rows: np.ndarray, columns: np.ndarray, subpixels: int = 1) -> np.ndarray:
    """The depth (..., n) in metres of what a frame sees in n = `subpixels`**2 places spread over each of the pixels at
    `rows` and `columns` (...); inf in the sky."""
    offsets = (np.arange(subpixels) + 0.5) / subpixels - 0.5
    dy, dx = (offset.ravel() for offset in np.meshgrid(offsets, offsets, indexing="ij"))
    x, y = columns[..., None] + dx, rows[..., None] + dy
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(world.intrinsics).T @ CAMERA_TO_EGO.T
    seconds = seconds_of(frame.timestamp)
    depth, _ = cast(world, world.ego_at(seconds) + CAMERA_AT, rays, seconds)
    return depth.reshape(x.shape)


def true_depths(world: World, frame: Frame, subpixels: int = 1) -> np.ndarray:
    """The same for all pixels: (h, w, n)."""
    return depths_at(world, frame, *np.indices((world.height, world.width)), subpixels)


def shows(world: World, frame: Frame, thing: Thing, subpixels: int = 1) -> np.ndarray:
    """Which pixels (h, w) of a frame show a thing at their centre (odd `subpixels`: anywhere), others in the world
    before it or not."""
    alone = World(**{**vars(world), "things": [thing]})
    empty = World(**{**vars(world), "things": []})
    return (true_depths(alone, frame, subpixels) < true_depths(empty, frame, subpixels)).any(axis=2)
