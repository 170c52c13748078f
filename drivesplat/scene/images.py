"""Reading and resizing recorded images, the pixel conventions, and the horizon.

`Scene` intrinsics follow OpenCV (integer coordinates at pixel centres). Rasterizers, projections and masks use the
continuous convention of COLMAP and gsplat (image corner at (0, 0), centre of the first pixel at (0.5, 0.5)), in which
resizing scales all coordinates.
"""

import math
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.io.storage import atomic_write
from drivesplat.scene.scene import Frame
from drivesplat.settings.images import ImageSettings

DECODING_ERRORS = (
    OSError, SyntaxError, ValueError, IndexError, OverflowError, struct.error, zlib.error, Image.DecompressionBombError,
)  # fmt: skip
"""What Pillow raises for files that are no image, or a damaged or absurdly large one."""
HORIZON_MARGIN = math.radians(1.0)
"""Minimum angle in radians of a ray below the horizontal plane. Allows for errors of recorded poses."""


def target_size(frame: Frame, images: ImageSettings) -> tuple[int, int]:
    """Width and height in pixels of a frame after resizing."""
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

    Raises DatasetError that names the path if the file is missing, truncated or not an image.
    """
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
    except DECODING_ERRORS as error:
        raise DatasetError(f"image {path} cannot be read ({error})") from error
    if size is None or size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def write_image(path: str | Path, colors: np.ndarray) -> None:
    """Writes colours (h, w, 3) in [0, 1] as a PNG. Raises ResultError that names the path on failure."""
    write_png(path, (colors.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8), level=1)


def write_png(path: str | Path, pixels: np.ndarray, level: int = 6) -> None:
    """Writes pixels as a PNG: uint8 (h, w) or (h, w, 3), or uint16 (h, w). `level` 1 takes a sixth of the time of 6
    and an eighth more disk.

    Raises ResultError that names the path on failure.
    """
    with atomic_write(path) as file:
        Image.fromarray(pixels).save(file, format="PNG", compress_level=level)


def read_mask(path: str | Path, size: tuple[int, int], of_image: tuple[int, int] | None = None) -> np.ndarray:
    """A label image (h, w) uint8, resized to `size` (width, height) by nearest neighbour.

    Raises DatasetError that names the path if the file cannot be read, has more than one channel of 8 bits (other than
    equal ones), or another aspect ratio than `of_image`, the size of the recorded image, if given.
    """
    try:
        with Image.open(path) as image:
            labels = _labels(image)
    except DECODING_ERRORS as error:
        raise DatasetError(f"mask {path} cannot be read ({error})") from error
    if labels is None:
        raise DatasetError(f"mask {path} has colours or more than 8 bits; save its labels as one channel of 8 bits")
    found = (labels.shape[1], labels.shape[0])
    if of_image is not None:
        (small_w, small_h), (large_w, large_h) = sorted((found, of_image))  # sides may be rounded to whole pixels
        if abs(small_h - large_h * small_w / large_w) > 1.0 and abs(small_w - large_w * small_h / large_h) > 1.0:
            raise DatasetError(
                f"mask {path} is {found[0]}x{found[1]}, and its image {of_image[0]}x{of_image[1]}: masks may have "
                "another size, but must have the image's aspect ratio"
            )
    if size == found:
        return labels
    return cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)


def _labels(image: Image.Image) -> np.ndarray | None:
    """The labels (h, w) uint8 of an image with one channel, or with equal ones; None where they are ambiguous."""
    if image.mode in ("L", "P"):
        return np.asarray(image)
    if image.mode in ("1", "LA"):
        return np.asarray(image.convert("L"))
    if image.mode not in ("RGB", "RGBA"):
        return None
    red, green, blue = (np.asarray(image)[..., i] for i in range(3))
    return red.copy() if (red == green).all() and (red == blue).all() else None


def project(points: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projects world points (n, 3): continuous pixels (n, 2) and depth along the optical axis (n,) in metres.

    Pixels of points with a depth that is not positive are undefined.
    """
    in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (in_camera[:, :2] / depth[:, None]) @ intrinsics[:2, :2].T + intrinsics[:2, 2]
    return pixels, depth


def upward_rays(size: tuple[int, int], intrinsics: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """The z components (h, w), in world coordinates, of the unit viewing directions of the pixel centres of an image of
    `size` (width, height): sines of the elevation where the world's z points up. `intrinsics` (3, 3) are in the
    continuous convention."""
    x, y = np.arange(size[0]) + 0.5, np.arange(size[1])[:, None] + 0.5
    to_ray = np.linalg.inv(intrinsics)
    up, square = camera_to_world[2, :3] @ to_ray, to_ray.T @ to_ray
    length = np.sqrt(
        (square[0, 0] * x + 2.0 * square[0, 2]) * x
        + (square[1, 1] * y + 2.0 * (square[1, 2] + square[0, 1] * x)) * y
        + square[2, 2]
    )
    return (up[0] * x + (up[1] * y + up[2])) / length


def below_horizon(
    K: Float[np.ndarray, "3 3"], camera_to_world: Float[np.ndarray, "4 4"], size: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """The pixels of an image of `size` (width, height) whose rays point more than HORIZON_MARGIN below the horizontal
    plane: they cannot show the sky. `K` is in continuous pixels; the camera is an OpenCV one, and the world's z points
    up.

    >>> K = np.array([[100.0, 0.0, 2.0], [0.0, 100.0, 2.0], [0.0, 0.0, 1.0]])
    >>> level = np.eye(4)
    >>> level[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    >>> below_horizon(K, level, (1, 6))[:, 0].tolist()  # pixels of 0.57 degrees
    [False, False, False, False, True, True]
    """
    return upward_rays(size, K, camera_to_world) < -math.sin(HORIZON_MARGIN)
