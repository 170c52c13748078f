"""Images as bytes of a request's format."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from drivesplat.serve.messages import wire


@dataclass(frozen=True)
class Encoding:
    """A `wire.ImageFormat`, and the quality of a JPEG, 1 to 100."""

    format: int
    quality: int


def _by_opencv(suffix: str, image: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)[1].tobytes()


FORMATS: dict[int, Callable[[UInt8[np.ndarray, "h w 3"], int], bytes]] = {
    wire.ImageFormat.PNG: lambda image, _: _by_opencv(".png", image),
    wire.ImageFormat.JPEG: lambda image, quality: _by_opencv(".jpg", image, cv2.IMWRITE_JPEG_QUALITY, quality),
    wire.ImageFormat.RGB_UINT8_PLANAR: lambda image, _: np.moveaxis(image, -1, 0).tobytes(),
}
"""The formats that are served: what encodes an image (h, w, 3), red first, at a quality."""


def encoded(image: UInt8[np.ndarray, "h w 3"], encoding: Encoding) -> bytes:
    """An image in a format. It releases Python's lock for most of its time: images are encoded in threads."""
    return FORMATS[encoding.format](image, encoding.quality)


def jpeg_on_device(planes: UInt8[Tensor, "3 h w"], quality: int) -> bytes:
    """A JPEG of an image that is complete, encoded where it is: on a GPU by nvJPEG, without a copy of the image, beside
    what else the GPU computes."""
    from torchvision.io import encode_jpeg  # here: it takes long to import

    with torch.cuda.stream(torch.cuda.Stream(planes.device)) if planes.is_cuda else nullcontext():
        return encode_jpeg(planes, quality=quality).cpu().numpy().tobytes()
