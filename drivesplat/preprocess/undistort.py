"""Distorted images, resampled as a pinhole camera would have recorded them: later stages know of no distortion.

The new camera has the centre and the size of the old one, and its focal length at the centre of the image, or the
smallest longer one with which every pixel has a source. No pixel is therefore empty, and no mask is needed; what lies
outside the new image is lost.
"""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.scene.images import read_image, read_mask, write_png
from drivesplat.scene.lens import central_intrinsics, pixels_of
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.sensors import Camera

LONGER = 1.01
"""Factor between the focal lengths that are tried."""
LONGEST = 10.0
"""Largest factor on the focal length."""


def undistorted(scene: Scene, folder: Path) -> Scene:
    """The scene with the images of distorted cameras resampled into `folder`, {camera}/{timestamp}.png, and with the
    intrinsics of these images. Class maps are resampled by nearest neighbour, into {camera}/{timestamp}_classes.png.

    Raises DatasetError naming a camera whose distortion cannot be undone at ten times its focal length.
    """
    maps = {camera.name: _maps(camera) for camera in scene.cameras if camera.distortion_model != "none"}

    def one(frame: Frame) -> Frame:
        if frame.camera not in maps:
            return frame
        k, x, y = maps[frame.camera]
        path = folder / frame.camera / f"{frame.timestamp}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, cv2.remap(read_image(frame.image_path), x, y, cv2.INTER_CUBIC), level=1)
        classes = None if frame.classes_path is None else str(path.with_name(f"{path.stem}_classes.png"))
        if frame.classes_path is not None and classes is not None:
            labels = read_mask(frame.classes_path, (frame.width, frame.height), (frame.width, frame.height))
            write_png(classes, cv2.remap(labels, x, y, cv2.INTER_NEAREST))
        return dataclasses.replace(frame, image_path=str(path), intrinsics=k, classes_path=classes)

    with ThreadPoolExecutor() as pool:
        frames = tuple(pool.map(one, scene.frames))
    cameras = tuple(_pinhole(camera, maps) for camera in scene.cameras)
    return dataclasses.replace(scene, frames=frames, cameras=cameras)


def _pinhole(camera: Camera, maps: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Camera:
    if camera.name not in maps:
        return camera
    k, x, y = maps[camera.name]
    return dataclasses.replace(
        camera, intrinsics=k, distortion=np.zeros(5), distortion_model="none", readout_s=_readout(camera, x, y)
    )


def _readout(camera: Camera, x: np.ndarray, y: np.ndarray) -> float | None:
    """The readout time of the new image: the line that fits the times of its pixels best, from edge to edge. `x` and
    `y` (h, w) are the sources of the pixels."""
    if camera.readout_s is None or camera.readout_direction is None:
        return camera.readout_s
    sources = x if camera.readout_direction in ("left", "right") else y.T
    lines = np.arange(sources.shape[1], dtype=np.float64)
    return camera.readout_s * float(np.polyfit(lines, sources.mean(axis=0), 1)[0])


def _maps(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The new intrinsics (3, 3), and for each pixel of the new image (h, w) the x and the y of its source."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    every = np.stack([columns, rows], axis=-1).astype(np.float64)
    border = np.concatenate([every[[0, -1]].reshape(-1, 2), every[:, [0, -1]].reshape(-1, 2)])
    factor = 1.0
    while factor <= LONGEST:
        k = central_intrinsics(camera) * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]]
        if _inside(camera, _sources(camera, k, border)):  # far fewer than all pixels, and mostly the farthest
            sources = _sources(camera, k, every.reshape(-1, 2))
            if _inside(camera, sources):
                x, y = sources.T.reshape(2, camera.height, camera.width).astype(np.float32)
                return k, x, y
        factor *= LONGER
    raise DatasetError(
        f"camera {camera.name}: its distortion leaves no image without empty pixels; check its coefficients"
    )


def _sources(camera: Camera, k: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The pixels (n, 2) of the recorded image that show what `pixels` (n, 2) of a pinhole image with `k` show."""
    return pixels_of(camera, np.column_stack([(pixels - k[:2, 2]) / k.diagonal()[:2], np.ones(len(pixels))]))


def _inside(camera: Camera, pixels: np.ndarray) -> bool:
    """Whether all pixels (n, 2) are within the image."""
    return bool(((pixels >= -0.5) & (pixels <= [camera.width - 0.5, camera.height - 0.5])).all())
