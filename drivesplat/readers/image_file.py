"""Faults of image files, for all readers."""

from pathlib import Path

from PIL import Image

from drivesplat.scene.images import DECODING_ERRORS
from drivesplat.scene.scene import Frame


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
                return f"image {path} is {image.size[0]}x{image.size[1]}, the tables say {frame.width}x{frame.height}"
            if image.mode.startswith(("I", "F")):
                return f"image {path} has more than 8 bits per channel ({image.mode}): convert it to 8 bits"
            image.draft("RGB", (frame.width // 8, frame.height // 8))
            image.load()
    except DECODING_ERRORS as error:
        return f"image {path} is corrupt ({error})"
    return None
