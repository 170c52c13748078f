"""The truth of a tiny world, cast ray by ray: recorded views, views from beside the path, and without the car ahead."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from drivesplat.readers.truth import TRUTH_FILE, Truth, TruthFrame, TruthView, write_truth_file
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene
from helpers.drives import CAMERA_AT, CAMERA_TO_EGO, ORIGIN, World, seconds_of, true_depths

LEADING = "0001 instance 0"
"""The car ahead, the first thing of a tiny world."""
OFFSETS = (2.0, -2.0, 4.0)
UNMADE = "not made.png"


def write_truth(root: Path, world: World, scene: Scene) -> Path:
    """Writes the truth of a tiny drive below its `root`; returns the path of truth.json.

    Images of instances are not made, nor any of a view of an edited drive and of one by another camera; class images
    show the sky alone.
    """
    empty = replace(world, things=world.things[1:])
    views = [_view(root, replace(world, left=left), scene, f"lateral {left}") for left in (0.0, *OFFSETS)]
    views.append(replace(_view(root, empty, scene, "empty"), without=LEADING))
    recorded = views[0]
    views.append(replace(recorded, left_m=2.0, edit="stop", frames=tuple(map(_unmade, recorded.frames))))
    others = tuple(replace(_unmade(frame), token=f"back {frame.key_frame}") for frame in recorded.frames)
    views += [replace(recorded, camera="CAM_BACK", left_m=left, frames=others) for left in (0.0, 2.0)]
    things = {str(number + 1): f"0001 instance {number}" for number in range(len(world.things))}
    truth = Truth(
        scene="0001", width=world.width, height=world.height, samples_per_pixel=1, leading=LEADING, instances=things,
        classes={"0": "sky"}, views=tuple(views), pattern=None, scans=(),
    )  # fmt: skip
    write_truth_file(root, truth)
    return root / TRUTH_FILE


def _unmade(frame: TruthFrame) -> TruthFrame:
    return replace(frame, image=UNMADE, depth=UNMADE, classes=UNMADE)


def _view(root: Path, world: World, scene: Scene, folder: str) -> TruthView:
    frames = [frame for frame in scene.frames if frame.is_key_frame]
    return TruthView("CAM_FRONT", world.left, None, None, tuple(_frame(root, world, frame, folder) for frame in frames))


def _frame(root: Path, world: World, frame: Frame, folder: str) -> TruthFrame:
    image, depth, classes = (f"{folder}/{kind}/{frame.sample_index:04}.png" for kind in ("image", "depth", "classes"))
    seconds = seconds_of(frame.timestamp)
    write_array(root / "truth" / image, world.image(seconds))
    write_array(root / "truth" / depth, depth_values(true_depths(world, frame)[..., 0]))
    write_array(root / "truth" / classes, np.zeros((world.height, world.width), dtype=np.uint8))
    pose = rigid(CAMERA_TO_EGO, ORIGIN + world.ego_at(seconds) + CAMERA_AT)
    return TruthFrame(frame.token, frame.sample_index, pose.tolist(), image, depth, UNMADE, classes)


def write_array(path: Path, values: np.ndarray) -> None:
    """Writes a PNG of 8 or 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def depth_values(depth: np.ndarray) -> np.ndarray:
    """Depth in metres as 16 bits: units of 1/256 m, 0 where infinite."""
    return np.where(np.isfinite(depth), np.minimum(np.round(256.0 * depth), 65535.0), 0.0).astype(np.uint16)
