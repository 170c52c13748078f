"""The recorded cameras for COLMAP and nerfstudio, in the world of splat.ply, with the intrinsics of the recorded images
in pixels of which the image's corner is (0, 0).

The stage `export_colmap` writes them with the seed points as a text model of COLMAP
(https://colmap.github.io/format.html): pinhole cameras; poses are world to camera in OpenCV's axes. No features: images
have no 2D points, and points have no tracks and an unknown error (0).

transforms.json of nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html) is part of the stage `export`.
A camera looks along -z there, with x to the right and y up, as in OpenGL; `transform_matrix` is camera to world.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.io.storage import atomic_write
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import inverse
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


@dataclass(frozen=True)
class ColmapFiles:
    """The outputs of the stage: cameras.txt, images.txt, points3D.txt."""

    cameras: str | Path
    images: str | Path
    points: str | Path


def export_colmap(files: ColmapFiles, scene: Scene, record: TrainingRecord) -> None:
    """Writes the text model of a scene, with the seed points of `record`. Raises ResultError naming a file that cannot
    be written."""
    cameras = {camera: i for i, camera in enumerate(dict.fromkeys(map(_camera, scene.frames)), start=1)}
    images = []
    for i, (frame, name) in enumerate(zip(scene.frames, image_names(scene.frames), strict=True), start=1):
        world_to_camera = inverse(frame.camera_to_world)
        quat = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat(scalar_first=True)
        pose = " ".join(map(str, [*quat.tolist(), *world_to_camera[:3, 3].tolist()]))
        images.append(f"{i} {pose} {cameras[_camera(frame)]} {name}\n")  # the next line would be its 2D points
    rows = enumerate(zip(record.points.tolist(), record.points_rgb.tolist(), strict=True), start=1)
    points = (f"{i} {x:.4f} {y:.4f} {z:.4f} {red} {green} {blue} 0" for i, ((x, y, z), (red, green, blue)) in rows)
    _write(files.cameras, "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", (f"{i} {text}" for text, i in cameras.items()))
    _write(files.images, "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", images)
    _write(files.points, "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", points)


def _camera(frame: Frame) -> str:
    """A frame's camera as a line of cameras.txt without its number."""
    K = continuous_intrinsics(frame, (frame.width, frame.height))
    return " ".join(map(str, ["PINHOLE", frame.width, frame.height, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))]))


def _write(path: str | Path, columns: str, lines: Iterable[str]) -> None:
    with atomic_write(path) as file:
        file.write(f"# {columns}\n".encode())
        file.writelines(f"{line}\n".encode() for line in lines)


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
