"""Captions of films: what each panel shows, the seconds of the drive, and where training images end."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from drivesplat.rendering.panels import Panels

BEYOND = "beyond the last training image"
HEIGHT_SHARE = 0.04
"""Height of the letters as a share of a panel's height."""
MIN_HEIGHT = 9
"""Pixels; smaller letters cannot be read."""
DARK = 24
"""Grey level, of 255, of pictures that show a text alone."""


@dataclass(frozen=True)
class Caption:
    """The texts in a frame: in each panel its label at the bottom left and a note at the top left (may be empty), and
    the `clock` at the film's top right."""

    labels: Sequence[str]
    notes: Sequence[str]
    clock: str


def drive_captions(
    labels: Sequence[str], seconds: Sequence[float], trained_until: float, notes: Sequence[str] = ()
) -> list[Caption]:
    """The captions of a film's frames at these `seconds`: BEYOND in the first panel after `trained_until`, and `notes`,
    one a frame if given, in the last."""
    captions = []
    for second, note in zip(seconds, notes or [""] * len(seconds), strict=True):
        own = [""] * len(labels)
        own[-1] = note
        if second > trained_until:
            own[0] = BEYOND
        captions.append(Caption(labels, own, f"{second:.1f} s"))
    return captions


def captioned(frames: Iterable[tuple[np.ndarray, Caption]], panels: Panels) -> Iterator[np.ndarray]:
    """Each picture (h, w, 3) uint8 of a film with its caption."""
    size = _letters(panels.size[1])
    margin = size // 2
    for picture, caption in frames:
        result = picture.copy()
        for number, (label, note) in enumerate(zip(caption.labels, caption.notes, strict=True)):
            panel, mask = panels.inside(result, number), text_mask(label, size)
            _write(panel, mask, margin, panel.shape[0] - margin - mask.shape[0])
            if note:
                _write(panel, text_mask(note, size), margin, margin)
        clock = text_mask(caption.clock, size)
        _write(result, clock, result.shape[1] - margin - clock.shape[1], margin)
        yield result


def text_picture(text: str, size: tuple[int, int]) -> np.ndarray:
    """A dark picture (h, w, 3) uint8 of `size`, width and height in pixels, with a text in its middle."""
    width, height = size
    picture, mask = np.full((height, width, 3), DARK, np.uint8), text_mask(text, _letters(height))
    _write(picture, mask, (width - mask.shape[1]) // 2, (height - mask.shape[0]) // 2)
    return picture


def _letters(height: int) -> int:
    """The height of letters in a panel of a height, in pixels."""
    return max(MIN_HEIGHT, round(HEIGHT_SHARE * height))


@lru_cache(maxsize=256)
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
