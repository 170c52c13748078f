"""Captions of films: what each column shows, the seconds of the drive, and where training images end."""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.images import HoldoutSettings

BEYOND = "beyond the last training image"
HEIGHT_SHARE = 0.04
"""Height of the letters as a share of the picture's height."""
MIN_HEIGHT = 9
"""Pixels; smaller letters cannot be read."""


def last_training_second(scene: Scene, camera: str, holdout: HoldoutSettings) -> float:
    """The second of a camera's last training image, since the scene's first image; infinite if there is none."""
    frames = [scene.frames[i] for i in training_images(scene, holdout)]
    times = [frame.timestamp for frame in frames if frame.camera == camera]
    return scene.seconds(max(times)) if times else np.inf


def captioned(
    pictures: Iterable[np.ndarray], seconds: Sequence[float], labels: Sequence[str], trained_until: float
) -> Iterator[np.ndarray]:
    """Each picture (h, w, 3) uint8 with captions: at the bottom left of each column its label, at the top right the
    `seconds` of the frame, and at the top left BEYOND where they are after `trained_until`."""
    for picture, second in zip(pictures, seconds, strict=True):
        result = picture.copy()
        height, width = picture.shape[:2]
        size = max(MIN_HEIGHT, round(HEIGHT_SHARE * height))
        margin = size // 2
        for column, label in enumerate(labels):
            mask = text_mask(label, size)
            _write(result, mask, margin + column * width // len(labels), height - margin - mask.shape[0])
        clock = text_mask(f"{second:.1f} s", size)
        _write(result, clock, width - margin - clock.shape[1], margin)
        if second > trained_until:
            _write(result, text_mask(BEYOND, size), margin, margin)
        yield result


@lru_cache(maxsize=64)
def text_mask(text: str, size: int) -> np.ndarray:
    """The coverage (h, w, 2) in [0, 1] of a text's letters and of their dark outline, in letters `size` pixels high."""
    font, outline = ImageFont.load_default(size), max(1, size // 10)
    left, top, right, bottom = font.getbbox(text, stroke_width=outline)
    layers = []
    for stroke in (0, outline):
        layer = Image.new("L", (int(right - left) + 1, int(bottom - top) + 1))
        ImageDraw.Draw(layer).text((-left, -top), text, fill=255, font=font, stroke_width=stroke)
        layers.append(np.asarray(layer, np.float32) / 255.0)
    return np.stack(layers, axis=-1)


def _write(picture: np.ndarray, mask: np.ndarray, left: int, top: int) -> None:
    """Writes white letters with a dark outline into `picture`; what does not fit is cut off."""
    target = picture[max(top, 0) : top + mask.shape[0], max(left, 0) : left + mask.shape[1]]
    part = mask[max(-top, 0) :, max(-left, 0) :][: target.shape[0], : target.shape[1]]
    letters, outline = part[..., :1], part[..., 1:]
    target[:] = (target * (1.0 - outline) + 255.0 * letters).round()
