"""The frames of films: what a model shows, as bytes in main memory, one after the other.

On a GPU a frame is asked for before the one before it has come, and only the end of a frame waits for the device: while
the GPU renders one, Python asks for the next.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.captured_frames import Asked, FramesOnGpu, Shown
from drivesplat.rendering.color_bytes import nearest_bytes

A = TypeVar("A")
NOT_FINITE = "a frame of a film was rendered as no numbers; delete its checkpoint.pt and rerun"


def film_frames(model: SplatModel, shown: Iterable[Shown]) -> Iterator[np.ndarray]:
    """What each view shows, (h, w, 3) uint8 RGB. Raises ResultError where one is not finite."""
    on_device = model.parts[0].params["means"].is_cuda
    yield from (_in_a_row(FramesOnGpu(model).asked, shown) if on_device else (_rendered(model, *one) for one in shown))


def film_frame(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """What one view shows, as `film_frames` says."""
    return next(film_frames(model, [(view, gaussians)]))


def as_bytes(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    """Colours in [0, 1] to the nearest byte, in main memory. Raises ResultError where they are not finite."""
    if not torch.isfinite(image).all():
        raise ResultError(NOT_FINITE)
    return nearest_bytes(image).cpu().numpy()


@torch.no_grad()
def _rendered(model: SplatModel, view: View, gaussians: Gaussians | None) -> np.ndarray:
    return as_bytes(model.render(view, gaussians=gaussians).image)


def _in_a_row(ask: Callable[[A], Asked], shown: Iterable[A]) -> Iterator[np.ndarray]:
    """The frames in order, each asked for before the one before it is waited for."""
    waiting: deque[Asked] = deque()
    for one in shown:
        waiting.append(ask(one))
        if len(waiting) > 1:
            yield _come(waiting.popleft())
    while waiting:
        yield _come(waiting.popleft())


def _come(asked: Asked) -> np.ndarray:
    asked.wait()
    if asked.cut_short:
        return _come(asked.again())
    if not asked.frame.finite:
        raise ResultError(NOT_FINITE)
    return asked.frame.pixels.numpy()
