"""The recorded cameras as transforms.json of nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html).

A camera looks along -z, with x to the right and y up, as in OpenGL; `transform_matrix` is camera to world. Intrinsics
are in pixels of the recorded images, in which the image's corner is (0, 0). The world is that of splat.ply.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.training_record import TrainingRecord

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
IMAGES = "images"
"""The folder beside transforms.json in which the images are expected."""
SEED = "../seed.ply"
"""The seed points, seen from the folder of transforms.json."""


def image_names(frames: Sequence[Frame]) -> list[str]:
    """Names of the recorded images in models for other programs: their paths, relative to the deepest folder that
    contains all of them: unique, and the same wherever the dataset is."""
    folder = os.path.commonpath([Path(frame.image_path).parent for frame in frames])
    return [Path(frame.image_path).relative_to(folder).as_posix() for frame in frames]


def transforms_record(scene: Scene, record: TrainingRecord) -> dict[str, Any]:
    """The images of a scene in the order of `scene.frames`, of which `record` is the training record, as nerfstudio
    reads them. Its validation and test images are those that are held out."""
    names, frames = [f"{IMAGES}/{name}" for name in image_names(scene.frames)], []
    for frame, name in zip(scene.frames, names, strict=True):
        K = continuous_intrinsics(frame, (frame.width, frame.height))
        entry = {
            "file_path": name,
            "w": frame.width,
            "h": frame.height,
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "transform_matrix": (frame.camera_to_world @ OPENCV_TO_OPENGL).tolist(),
            "timestamp": frame.timestamp,
            "camera": frame.camera,
        }
        frames.append(entry)
    training = [names[i] for i in record.train_images]
    others = {split: rows for split, rows in record.splits.items() if split not in ("train", "excluded")}
    held_out = [names[i] for rows in others.values() for i in rows.tolist()]
    splits = {"train_filenames": training, "val_filenames": held_out, "test_filenames": held_out}
    return {
        "camera_model": "OPENCV",
        "ply_file_path": SEED,
        **(splits if training and held_out else {}),
        "frames": frames,
    }
