"""Colours as 8-bit integers."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drivesplat.errors import ResultError

NOT_FINITE = "a frame of a film contains NaN or Inf; delete its checkpoint.npz and rerun"


def to_uint8(colors: Float[Tensor, "*n 3"]) -> UInt8[Tensor, "*n 3"]:
    """Colours in [0, 1] rounded to the nearest uint8, on their device; values beyond [0, 1] are clipped."""
    return (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def uint8_image(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    """Colours in [0, 1] as the nearest uint8, in main memory. Raises ResultError where one is NaN or Inf."""
    return uint8_images([image])[0]


def uint8_images(images: Sequence[Float[Tensor, "_ _ 3"]]) -> list[np.ndarray]:
    """Images of one device, each as `uint8_image` gives it; a GPU is waited for once for all of them."""
    return [pixels.numpy() for pixels in _finished([(image, to_host(to_uint8(image))) for image in images])]


def planes_on_device(images: Sequence[Float[Tensor, "_ _ 3"]]) -> list[UInt8[Tensor, "3 _ _"]]:
    """Images of one device as uint8, a plane for each channel, on their device, which is waited for once. Raises
    ResultError where a colour is NaN or Inf."""
    return _finished([(image, to_uint8(image).permute(2, 0, 1).contiguous()) for image in images])


def _finished(made: Sequence[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """What was made of images, when it is there. Raises ResultError where an image is not finite."""
    finite = [to_host(all_finite(image)) for image, _ in made]
    if made and made[0][0].is_cuda:
        torch.cuda.current_stream(made[0][0].device).synchronize()
    if not all(finite):
        raise ResultError(NOT_FINITE)
    return [result for _, result in made]


def all_finite(image: Float[Tensor, "_ _ 3"]) -> Bool[Tensor, ""]:
    """Whether no colour is NaN or Inf. On a CPU, a finite sum says so 40 times faster than a look at each of them."""
    if not image.is_cuda:
        finite = torch.isfinite(image.sum())
        if finite:
            return finite
    return torch.isfinite(image).all()


def to_host(values: Tensor) -> Tensor:
    """A copy in main memory; from a GPU an asynchronous one in pinned memory, which is several times faster than one
    into pageable memory."""
    if not values.is_cuda:
        return values
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
