"""Renderings of a drive as pictures to look at: colours, depth, opacity, objects, classes, and errors of an image."""

import colorsys
import zlib
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from drivesplat.drive.drive_view import DriveView

Picture = UInt8[np.ndarray, "_ _ 3"]
MIN_DEPTH, MAX_DEPTH = 2.0, 80.0
"""Metres between which the colours of depth run; they are logarithmic."""
GOLDEN = 0.61803398875
"""Turns of the hue from one number to the next, so that neighbouring ones differ."""
GREY = 60
"""The grey level of what is no object."""
MAX_ERROR = 0.25
"""The mean difference of colours, of at most 1, that is drawn white."""


def number_colors(count: int) -> UInt8[np.ndarray, "n 3"]:
    """Colours of the numbers from 0 to `count` - 1."""
    shades = [colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.75, 1.0) for number in range(count)]
    return (255.0 * np.array(shades).reshape(-1, 3)).round().astype(np.uint8)


def name_colors(names: Sequence[str]) -> UInt8[np.ndarray, "n 3"]:
    """A colour for each name, always the same for a name."""
    shades = [colorsys.hsv_to_rgb(zlib.crc32(name.encode()) / 2**32, 0.75, 1.0) for name in names]
    return (255.0 * np.array(shades).reshape(-1, 3)).round().astype(np.uint8)


def depth_picture(depth: np.ndarray) -> Picture:
    """Near surfaces red, far ones blue, none black. `depth` (h, w) in metres."""
    far = np.log(np.clip(depth, MIN_DEPTH, MAX_DEPTH) / MIN_DEPTH) / np.log(MAX_DEPTH / MIN_DEPTH)
    colors = cv2.applyColorMap((255.0 * (1.0 - far)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(depth[..., None] > 0.0, colors, 0).astype(np.uint8)


def with_rest(colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "_ 3"]:
    """Colours, and last the grey of what has none, which the index -1 finds."""
    return np.concatenate([colors, np.full((1, 3), GREY, dtype=np.uint8)])


def _alpha(view: DriveView) -> Picture:
    grey = (255.0 * view.arrays()["alpha"].clip(0.0, 1.0)).round().astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


PICTURES: dict[str, tuple[str, Callable[[DriveView], Picture]]] = {
    "colour": ("rgb", lambda view: view.image),
    "depth": ("depth", lambda view: depth_picture(view.arrays()["depth"])),
    "opacity": ("alpha", _alpha),
    "objects": ("instance", lambda view: with_rest(name_colors(view.objects))[view.arrays()["instance"]]),
    "classes": ("semantic", lambda view: number_colors(len(view.classes))[view.arrays()["semantic"]]),
}
"""What can be looked at: the output that it needs, and the picture of a rendering with this output."""


def error_picture(image: Picture, recorded: Picture) -> Picture:
    """The mean difference between the colours of two images, black to white at MAX_ERROR."""
    difference = np.abs(image.astype(np.float32) - recorded).mean(axis=2) / 255.0
    grey = (255.0 * (difference / MAX_ERROR).clip(0.0, 1.0)).round().astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def blended(image: Picture, recorded: Picture, share: float) -> Picture:
    """An image under a recorded one of the same size that has this share."""
    return np.round((1.0 - share) * image.astype(np.float32) + share * recorded).astype(np.uint8)


def placed(picture: Picture, point: np.ndarray, width: int, height: int) -> Picture:
    """A black picture of a size with another one on it, whose `point` (x, y) in pixels is in its middle."""
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    left, top = np.round([0.5 * width - point[0], 0.5 * height - point[1]]).astype(int).tolist()
    rows = slice(max(0, top), min(height, top + picture.shape[0]))
    columns = slice(max(0, left), min(width, left + picture.shape[1]))
    canvas[rows, columns] = picture[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return canvas
