"""Images of all kinds that Pillow opens: read as what they show, or refused with a rule that converts them."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from drivesplat.readers.image_file import image_fault
from drivesplat.scene.images import read_image
from drivesplat.scene.scene import Frame

WIDTH, HEIGHT = 96, 54
RAMP = np.tile(np.linspace(0.0, 1.0, WIDTH), (HEIGHT, 1))
COLORS = np.stack([RAMP, RAMP[:, ::-1], 0.5 * RAMP], axis=-1)
"""An image (h, w, 3) in [0, 1]."""
EIGHT = (COLORS * 255).round().astype(np.uint8)
GREY = np.repeat((RAMP * 255).round().astype(np.uint8)[..., None], 3, axis=2)


def frame_of(path: Path) -> Frame:
    return Frame("front", 0, str(path), WIDTH, HEIGHT, np.eye(3), np.eye(4), np.eye(4), True, 0, "")


def deep(values: np.ndarray) -> np.ndarray:
    return (values * 65535).round().astype(np.uint16)


def with_opacity(values: np.ndarray) -> np.ndarray:
    return np.dstack([values, np.full((HEIGHT, WIDTH), np.iinfo(values.dtype).max, values.dtype)])


DEEP = {
    "grey.png": (deep(RAMP), GREY),
    "color.png": (deep(COLORS), EIGHT),
    "opaque.png": (with_opacity(deep(COLORS)), EIGHT),
    "grey.tif": (deep(RAMP), GREY),
    "color.tif": (deep(COLORS), EIGHT),
    "float_grey.tif": (RAMP.astype(np.float32), GREY),
    "float_color.tif": (COLORS.astype(np.float32), EIGHT),
    "color.ppm": (deep(COLORS), EIGHT),
}
"""Pixels by file, and what the image shows in 8 bits."""


@pytest.mark.parametrize("name", DEEP)
def test_images_of_more_than_8_bits_are_refused_with_a_line_that_converts_them(name, tmp_path):
    """Colours of 16 bits, too, whose lower bytes Pillow would drop: an image of 12 bits in 16 would be black."""
    pixels, shown = DEEP[name]
    order = [2, 1, 0, 3][: pixels.shape[2]] if pixels.ndim == 3 else slice(None)
    options = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE] if name.endswith("tif") else []
    cv2.imwrite(str(tmp_path / name), pixels[..., order] if pixels.ndim == 3 else pixels, options)
    fault = image_fault(frame_of(tmp_path / name))
    assert fault and str(tmp_path / name) in fault and "\n" not in fault and "corrupt" not in fault
    (line,) = re.findall(r"`(.*?)`", fault)
    exec(line, {"cv2": cv2, "old": str(tmp_path / name), "new": str(tmp_path / "eight.png")})
    assert image_fault(frame_of(tmp_path / "eight.png")) is None
    assert np.abs(read_image(tmp_path / "eight.png").astype(int) - shown).max() <= ("float" in name)


def test_integers_of_32_bits_are_refused(tmp_path):
    Image.fromarray((RAMP * 1000).astype(np.int32)).save(tmp_path / "a.tif")
    assert "more than 8 bits per channel (I)" in (image_fault(frame_of(tmp_path / "a.tif")) or "")


def translucent(image: Image.Image) -> Image.Image:
    """Half of it transparent."""
    image.putalpha(Image.fromarray((RAMP > 0.5).astype(np.uint8) * 255))
    return image


EIGHT_BITS = {
    "rgb.png": (Image.Image.copy, 0), "rgb.tif": (Image.Image.copy, 0), "rgb.jpg": (Image.Image.copy, 8),
    "palette.png": (Image.Image.quantize, 4), "palette.gif": (Image.Image.quantize, 4), "alpha.png": (translucent, 0),
    "cmyk.tif": (lambda image: image.convert("CMYK"), 1), "cmyk.jpg": (lambda image: image.convert("CMYK"), 8),
    "grey.png": (lambda _: Image.fromarray(GREY[..., 0]), 0), "grey.jpg": (lambda _: Image.fromarray(GREY[..., 0]), 4),
    "grey_alpha.png": (lambda _: Image.fromarray(GREY[..., 0]).convert("LA"), 0),
}  # fmt: skip
"""What makes each of the image of colours, and the largest error."""


@pytest.mark.parametrize("name", EIGHT_BITS)
def test_images_of_8_bits_are_read_as_what_they_show(name, tmp_path):
    """Alpha is ignored: the colours of transparent pixels are those of the file."""
    convert, tolerance = EIGHT_BITS[name]
    convert(Image.fromarray(EIGHT)).save(tmp_path / name)
    assert image_fault(frame_of(tmp_path / name)) is None
    read = read_image(tmp_path / name)
    assert read.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(read.astype(int) - (GREY if name.startswith("grey") else EIGHT)).max() <= tolerance
