"""The frames of films: renderings of a model as 8-bit images in main memory, in order.

On a GPU, Python submits the next frame while the GPU renders the one before it.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.color_bytes import NOT_FINITE, to_host, to_uint8, uint8_image
from drivesplat.rendering.fixed_model import FixedModel, Pending, RenderedImage, overflowed

T = TypeVar("T")
FrameInput = tuple[View, Gaussians | Sequence[Gaussians] | None]
"""A view, and the Gaussians to render in place of the model's own at its time (None: the model's own)."""


@dataclass(frozen=True)
class PendingFrame:
    """A frame that the device is rendering. After `wait` its `pixels`, whether its colours were `finite`, and the
    numbers of entries that its lists `needed`, of their `capacities`, are in main memory. `retry` renders it with exact
    capacities."""

    pixels: UInt8[Tensor, "h w 3"]
    finite: Bool[Tensor, ""]
    needed: Int[Tensor, " lists"]
    capacities: Sequence[int]
    wait: Callable[[], None]
    retry: Callable[[], "PendingFrame"]


def film_frames(model: SplatModel | FixedModel, inputs: Iterable[FrameInput]) -> Iterator[np.ndarray]:
    """Renders each view, (h, w, 3) uint8 RGB. Raises ResultError where a rendering contains NaN or Inf."""
    fixed = model if isinstance(model, FixedModel) else FixedModel(model)
    wanted = ((view, _sets(fixed, view, gaussians)) for view, gaussians in inputs)
    if fixed.model.parts[0].params["means"].is_cuda:
        yield from _pipelined(lambda one: _on_its_way(fixed.submit(*one)), wanted)
    else:
        for view, sets in wanted:
            yield uint8_image(fixed.render(view, sets).image)


def film_frame(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """Renders one view as `film_frames` does."""
    return next(film_frames(model, [(view, gaussians)]))


def _sets(fixed: FixedModel, view: View, gaussians: Gaussians | Sequence[Gaussians] | None) -> Sequence[Gaussians]:
    if gaussians is None:
        return fixed.sample_in(view)
    return [gaussians] if isinstance(gaussians, Gaussians) else gaussians


@torch.no_grad()
def _on_its_way(pending: Pending[RenderedImage]) -> PendingFrame:
    """The frame of an image, with its copies into main memory submitted."""
    copied, image = torch.cuda.Event(), pending.rendered.image
    pixels, finite = to_host(to_uint8(image)), to_host(torch.isfinite(image).all())
    needed = to_host(pending.needed)
    copied.record()
    return PendingFrame(
        pixels, finite, needed, pending.capacities, copied.synchronize, lambda: _on_its_way(pending.retry())
    )


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
    if overflowed(pending.needed.tolist(), pending.capacities):
        return _finished(pending.retry())
    if not pending.finite:
        raise ResultError(NOT_FINITE)
    return pending.pixels.numpy()
