"""The frames of films: renderings of a model as 8-bit images in main memory, in order.

On a GPU, Python submits the next frame while the GPU renders the one before it.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
import torch

from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.captured_frames import FrameInput, GpuFrameRenderer, PendingFrame
from drivesplat.rendering.color_bytes import NOT_FINITE, uint8_image

T = TypeVar("T")


def film_frames(model: SplatModel, inputs: Iterable[FrameInput]) -> Iterator[np.ndarray]:
    """Renders each view, (h, w, 3) uint8 RGB. Raises ResultError where a rendering contains NaN or Inf."""
    if model.parts[0].params["means"].is_cuda:
        yield from _pipelined(GpuFrameRenderer(model).submit, inputs)
    else:
        for view, gaussians in inputs:
            with torch.no_grad():
                image = model.render(view, gaussians=gaussians).image
            yield uint8_image(image)


def film_frame(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """Renders one view as `film_frames` does."""
    return next(film_frames(model, [(view, gaussians)]))


def _pipelined(submit: Callable[[T], PendingFrame], inputs: Iterable[T]) -> Iterator[np.ndarray]:
    """The frames in order; each is submitted before the one before it is waited for."""
    pending: deque[PendingFrame] = deque()
    for one in inputs:
        pending.append(submit(one))
        if len(pending) > 1:
            yield _finished(pending.popleft())
    while pending:
        yield _finished(pending.popleft())


def _finished(pending: PendingFrame) -> np.ndarray:
    pending.wait()
    if pending.overflowed:
        return _finished(pending.retry())
    if not pending.frame.finite:
        raise ResultError(NOT_FINITE)
    return pending.frame.pixels.numpy()
