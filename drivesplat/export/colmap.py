"""The stage `export_colmap`: the recorded cameras and the seed points as a text model of COLMAP
(https://colmap.github.io/format.html).

Pinhole cameras with the intrinsics of the recorded images, in COLMAP's pixels (the image's corner is (0, 0)); poses are
world to camera in OpenCV's axes. The world is that of splat.ply. No features: images have no 2D points, and points have
no tracks and an unknown error (0).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from drivesplat.export.nerfstudio import image_names
from drivesplat.io.storage import atomic_write
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.training_record import TrainingRecord


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
