"""The recorded cameras as cameras.json, which places splat.ply in the world and in time."""

from typing import Any

import numpy as np

from drivesplat.export.scene_header import scene_header
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.training_record import TrainingRecord

SCHEMA = 1
CONVENTIONS = {
    "world": "Metres, z up, the axes of the dataset's global frame; splat.ply is in these coordinates.",
    "camera": "OpenCV: x right, y down, z forward, metres; pinhole without distortion.",
    "ego": "The recording vehicle: x forward, y left, z up, on the ground under the rear axle.",
    "K": "Continuous pixels of an image of width x height: the image's corner is (0, 0), "
    "the first pixel's centre (0.5, 0.5).",
    "transforms": "Matrices 4x4, row by row, applied to column vectors: world = camera_to_world camera.",
    "timestamp": "Microseconds of the dataset's clock; each image has its own, and its poses are those at that time.",
    "sample_index": "The index of the image's key frame; for other images that of the nearest key frame in time.",
    "split": "The use of the image: train, held out for interpolation or extrapolation, "
    "or excluded because a held-out image is near.",
}


def cameras_record(scene: Scene, record: TrainingRecord) -> dict[str, Any]:
    """The images of a scene as plain data in the order of `scene.frames`, of which `record` is the training record.

    Poses and `origin` have full float64 precision; sizes and K are those of the training images.
    """
    split_of = {int(i): split for split, images in record.splits.items() for i in images}
    return {
        **scene_header(scene, SCHEMA, CONVENTIONS),
        "key_frame_timestamps": scene.key_frame_timestamps.tolist(),
        "images": [
            _image(frame, record.image_names[i], record.image_size(i), record.Ks[i], split_of[i])
            for i, frame in enumerate(scene.frames)
        ],
    }


def _image(frame: Frame, name: str, size: tuple[int, int], K: np.ndarray, split: str) -> dict[str, Any]:
    return {
        "camera": frame.camera,
        "timestamp": frame.timestamp,
        "image": name,
        "width": size[0],
        "height": size[1],
        "K": K.tolist(),
        "camera_to_world": frame.camera_to_world.tolist(),
        "ego_to_world": frame.ego_to_world.tolist(),
        "is_key_frame": frame.is_key_frame,
        "sample_index": frame.sample_index,
        "split": split,
    }
