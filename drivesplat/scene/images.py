"""Recorded images, read and resized; one place for the pixel conventions.

`Scene` intrinsics are OpenCV's (integer coordinates at pixel centres). Rasterizers, projections and masks use the
continuous convention of COLMAP and gsplat (the image's corner is (0, 0), the first pixel's centre (0.5, 0.5)), in which
resizing is a plain scaling.
"""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from drivesplat.errors import DatasetError
from drivesplat.io.storage import atomic_write
from drivesplat.scene.scene import Frame
from drivesplat.settings.images import ImageSettings


def target_size(frame: Frame, images: ImageSettings) -> tuple[int, int]:
    """Width and height in pixels at which a frame is used."""
    if images.width is None:
        return frame.width, frame.height
    return images.width, max(1, round(frame.height * images.width / frame.width))


def continuous_intrinsics(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """The frame's K (3, 3) at `size` (width, height), in the continuous pixel convention."""
    k = frame.intrinsics.copy()
    k[:2, 2] += 0.5
    return np.diag([size[0] / frame.width, size[1] / frame.height, 1.0]) @ k


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """An image as RGB (h, w, 3) uint8, at `size` (width, height) if given.

    Raises DatasetError naming the path where the file is missing, truncated or no image.
    """
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError, SyntaxError) as error:
        raise DatasetError(f"image {path} cannot be read ({error})") from error
    if size is None or size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def write_image(path: str | Path, colors: np.ndarray) -> None:
    """Writes colours (h, w, 3) in [0, 1] as a PNG. Raises ResultError naming the path where that fails."""
    write_png(path, (colors.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))


def write_png(path: str | Path, pixels: np.ndarray) -> None:
    """Writes bytes (h, w) or (h, w, 3) as a PNG. Raises ResultError naming the path where that fails."""
    with atomic_write(path) as file:
        Image.fromarray(pixels).save(file, format="PNG")


def read_mask(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    """A label image (h, w) uint8, brought to `size` (width, height) by nearest neighbour.

    Raises DatasetError naming the path.
    """
    try:
        with Image.open(path) as image:
            labels = np.asarray(image if image.mode in ("L", "P") else image.convert("L"))
    except (OSError, UnidentifiedImageError, SyntaxError) as error:
        raise DatasetError(f"mask {path} cannot be read ({error})") from error
    if size == (labels.shape[1], labels.shape[0]):
        return labels
    return cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)


def project(points: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points (n, 3) in an image: continuous pixels (n, 2) and depth along the axis (n,), metres.

    Where depth is not positive the pixel is meaningless.
    """
    in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (in_camera[:, :2] / depth[:, None]) @ intrinsics[:2, :2].T + intrinsics[:2, 2]
    return pixels, depth


def pixel_rays(size: tuple[int, int], intrinsics: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """The unit viewing direction (h, w, 3) of every pixel's centre, in world coordinates."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(intrinsics).T @ camera_to_world[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
