"""The recorded cameras as transforms.json of nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html).

A camera looks along -z, with x to the right and y up, as in OpenGL; `transform_matrix` is camera to world. Intrinsics
are in pixels of the recorded images, in which the image's corner is (0, 0). The world is that of splat.ply.
"""

from typing import Any

import numpy as np

from drivesplat.export.image_names import image_names
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.training_record import TrainingRecord

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
IMAGES = "images"
"""The folder beside transforms.json in which the images are expected."""
SEED = "../seed.ply"
"""The seed points, seen from the folder of transforms.json."""


def transforms_record(scene: Scene, record: TrainingRecord) -> dict[str, Any]:
    """The images of a scene in the order of `scene.frames`, of which `record` is the training record, as nerfstudio
    reads them. Its validation and test images are those that are held out."""
    names = [f"{IMAGES}/{name}" for name in image_names(scene.frames)]
    training = [names[i] for i in record.train_images]
    held_out = [names[i] for split, rows in record.splits.items() if split not in _NOT_HELD_OUT for i in rows.tolist()]
    splits = {"train_filenames": training, "val_filenames": held_out, "test_filenames": held_out}
    return {
        "camera_model": "OPENCV",
        "ply_file_path": SEED,
        **(splits if training and held_out else {}),
        "frames": [_frame(frame, name) for frame, name in zip(scene.frames, names, strict=True)],
    }


_NOT_HELD_OUT = ("train", "excluded")


def _frame(frame: Frame, name: str) -> dict[str, Any]:
    K = continuous_intrinsics(frame, (frame.width, frame.height))
    return {
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
