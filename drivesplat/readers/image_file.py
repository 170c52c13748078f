"""Faults of image files, for all readers."""

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from drivesplat.scene.images import DECODING_ERRORS
from drivesplat.scene.scene import Frame

TIFF = (b"II*\0", b"MM\0*")
"""How TIFF files begin."""
HOW = (
    "convert all images to 8 bits by one rule, such as `cv2.imwrite(new, (cv2.imread(old, cv2.IMREAD_UNCHANGED) / "
    "{peak} * 255).clip(0, 255).round().astype('uint8'))`, where {peak} is the value of white (docs/own_data.md)"
)


def image_fault(frame: Frame) -> str | None:
    """The fault of a frame's image file, or None.

    Decodes the image at reduced size: a truncated JPEG opens without error.
    """
    path = Path(frame.image_path)
    if not path.is_file():
        return f"image {path} is missing"
    try:
        with Image.open(path) as image:
            if image.size != (frame.width, frame.height):
                return (
                    f"image {path} is {image.size[0]}x{image.size[1]}, but was recorded as {frame.width}x{frame.height}"
                )
            if deep := _deep_mode(image):
                peak = "1.0" if deep.startswith("F") else "65535"
                return f"image {path} has more than 8 bits per channel ({deep}): {HOW.format(peak=peak)}"
            image.draft("RGB", (frame.width // 8, frame.height // 8))
            image.load()
    except UnidentifiedImageError as error:
        if path.read_bytes()[:4] in TIFF:
            return f"image {path} is a TIFF that cannot be read, such as one of floats: {HOW.format(peak='1.0')}"
        return f"image {path} is corrupt ({error})"
    except DECODING_ERRORS as error:
        return f"image {path} is corrupt ({error})"
    return None


def _deep_mode(image: Image.Image) -> str | None:
    """The mode in which the file of an image stores more than 8 bits per channel; None where it does not. Pillow opens
    colours of 16 bits as RGB and drops their lower byte."""
    if image.mode.startswith(("I", "F")):
        return image.mode
    for _, _, _, arguments in image.tile:
        raw, *more = arguments if isinstance(arguments, tuple) else (arguments,)
        if isinstance(raw, str) and (";16" in raw or (image.format == "PPM" and more and more[0] > 255)):
            return raw
    return None
