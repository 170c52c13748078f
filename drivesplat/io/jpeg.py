"""JPEG files of rendered and converted images."""

from io import BytesIO

import numpy as np
from PIL import Image

QUALITY = 95


def encoded_jpeg(pixels: np.ndarray) -> bytes:
    """The JPEG file of (h, w, 3) or (h, w) uint8 at QUALITY, with colours at full resolution."""
    file = BytesIO()
    Image.fromarray(pixels).save(file, format="JPEG", quality=QUALITY, subsampling=0)
    return file.getvalue()
