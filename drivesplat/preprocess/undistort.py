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
from drivesplat.scene.lens import central_intrinsics, lens_fault, pixels_of
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.sensors import Camera

LONGER = 1.01
"""Factor between the focal lengths that are tried."""
LONGEST = 3.0
"""Largest factor on the focal length. Coefficients that need more are those of another model."""
MAX_TANGENTIAL = 0.1
"""Largest p1 and p2 of OpenCV's model. Real lenses are below 0.02."""
_LIKELY_CAUSE = "its coefficients are probably those of another model, or in another order or unit"


def undistorted(scene: Scene, folder: Path) -> Scene:
    """The scene with the images of distorted cameras resampled into `folder`, {camera}/{timestamp}.png, and with the
    intrinsics of these images. Class maps are resampled by nearest neighbour, into {camera}/{timestamp}_classes.png.

    Raises DatasetError naming a camera whose distortion cannot be undone: `distortion_fault`.
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
    cameras = list(scene.cameras)
    for i, camera in enumerate(cameras):
        if camera.name in maps:
            k, x, y = maps[camera.name]
            cameras[i] = dataclasses.replace(
                camera, intrinsics=k, distortion=np.zeros(5), distortion_model="none", readout_s=_readout(camera, x, y)
            )
    return dataclasses.replace(scene, frames=frames, cameras=tuple(cameras))


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
    assert camera.distortion is not None
    if camera.distortion_model == "opencv" and np.abs(camera.distortion[2:4]).max() > MAX_TANGENTIAL:
        p1, p2 = camera.distortion[2:4]  # radial coefficients in their place
        raise DatasetError(
            f"camera {camera.name}: its distortion has p1 = {p1:g} and p2 = {p2:g}, more than {MAX_TANGENTIAL:g}; the "
            f"order of opencv coefficients is k1, k2, p1, p2, k3, and {_LIKELY_CAUSE}"
        )
    if fault := lens_fault(camera):
        raise DatasetError(f"camera {camera.name}: {fault}")
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
                # A step to the right and a step down in the new image are so in their sources, up to a rotation.
                (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
                folded = float((x_right * y_down - x_down * y_right <= 0).mean())
                if folded:
                    raise DatasetError(
                        f"camera {camera.name}: its distortion folds in {folded:.1%} of the image: two directions have "
                        f"one pixel; {_LIKELY_CAUSE}"
                    )
                return k, x, y
        factor *= LONGER
    raise DatasetError(
        f"camera {camera.name}: its distortion leaves no image without empty pixels at {LONGEST:g} times its focal "
        f"length; {_LIKELY_CAUSE}"
    )


def _sources(camera: Camera, k: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The pixels (n, 2) of the recorded image that show what `pixels` (n, 2) of a pinhole image with `k` show."""
    return pixels_of(camera, np.column_stack([(pixels - k[:2, 2]) / k.diagonal()[:2], np.ones(len(pixels))]))


def _inside(camera: Camera, pixels: np.ndarray) -> bool:
    """Whether all pixels (n, 2) are within the image."""
    return bool(((pixels >= -0.5) & (pixels <= [camera.width - 0.5, camera.height - 0.5])).all())


def distortion_fault(camera: Camera) -> str | None:
    """Why images of a camera cannot be resampled, or None."""
    try:
        view_kept(camera)
    except DatasetError as error:
        return str(error)
    return None


def view_kept(camera: Camera) -> float:
    """The part of the recorded image that the resampled one shows, 1 without distortion. Raises DatasetError where
    it cannot be resampled."""
    if camera.distortion_model == "none":
        return 1.0
    _, x, y = _maps(camera)
    border = [np.concatenate([m[0], m[1:, -1], m[-1, -2::-1], m[-2:0:-1, 0]]).astype(np.float64) for m in (x, y)]
    area = 0.5 * abs(float(border[0] @ np.roll(border[1], -1) - border[1] @ np.roll(border[0], -1)))
    return area / (camera.width * camera.height)
