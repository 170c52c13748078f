"""The frames of films: what a model shows, as bytes in main memory, one after the other.

On a GPU a frame is asked for before the one before it has come, and only the end of a frame waits for the device: while
the GPU renders one, Python asks for the next.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.on_gpu import rooms

A = TypeVar("A")
Shown = tuple[View, Gaussians | None]
"""A view, and the Gaussians that stand in for those that the model has at its time (None: none do)."""
NOT_FINITE = "a frame of a film was rendered as no numbers; delete its checkpoint.pt and rerun"


def film_frames(model: SplatModel, shown: Iterable[Shown]) -> Iterator[np.ndarray]:
    """What each view shows, (h, w, 3) uint8 RGB. Raises ResultError where one is not finite."""
    on_device = model.parts[0].params["means"].is_cuda
    yield from (_in_a_row(_Device(model).asked, shown) if on_device else (_rendered(model, *one) for one in shown))


def film_frame(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """What one view shows, as `film_frames` says."""
    return next(film_frames(model, [(view, gaussians)]))


def as_bytes(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    """Colours in [0, 1] to the nearest byte. Raises ResultError where they are not finite."""
    if not torch.isfinite(image).all():
        raise ResultError(NOT_FINITE)
    return _bytes(image).cpu().numpy()


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


@torch.no_grad()
def _rendered(model: SplatModel, view: View, gaussians: Gaussians | None) -> np.ndarray:
    return as_bytes(model.render(view, gaussians=gaussians).image)


@dataclass(frozen=True)
class _Asked:
    """A frame that the device was asked for: `pixels`, and what is `told` of it, whether anything was not finite and
    how many entries each of its lists needs, in main memory after `wait`; the `rooms` that these lists have; and how to
    ask for it `again`."""

    pixels: UInt8[Tensor, "h w 3"]
    told: Int[Tensor, " told"]
    rooms: Sequence[int]
    wait: Callable[[], None]
    again: Callable[[], "_Asked"]


class _Device:
    """A model on a GPU, which is asked for frames: for the first it says how much room its lists of Gaussians need, the
    others get that and a margin."""

    def __init__(self, model: SplatModel):
        self._model = model
        self._needs: list[int] | None = None

    @torch.no_grad()
    def asked(self, shown: Shown, by_itself: bool = False) -> _Asked:
        """A frame that was asked for; `by_itself` with all the room it needs, for which the device is waited for."""
        view, gaussians = shown
        lists: list[tuple[Int[Tensor, ""], int]] = []
        if self._needs is None or by_itself:
            with rooms.counted() as needs:
                image = self._model.render(view, gaussians=gaussians).image
            self._needs = [max(pair) for pair in zip(needs, self._needs or needs, strict=True)]
        else:
            with rooms.given(self._needs) as lists:
                image = self._model.render(view, gaussians=gaussians).image
        told = torch.stack([(~torch.isfinite(image)).any().long(), *(needed.long() for needed, _ in lists)])
        come = torch.cuda.Event()
        pixels, told = _to_host(_bytes(image)), _to_host(told)
        come.record()
        room = [room for _, room in lists]
        return _Asked(pixels, told, room, come.synchronize, lambda: self.asked(shown, by_itself=True))


def _in_a_row(ask: Callable[[A], _Asked], shown: Iterable[A]) -> Iterator[np.ndarray]:
    """The frames in order, each asked for before the one before it is waited for."""
    waiting: deque[_Asked] = deque()
    for one in shown:
        waiting.append(ask(one))
        if len(waiting) > 1:
            yield _come(waiting.popleft())
    while waiting:
        yield _come(waiting.popleft())


def _come(frame: _Asked) -> np.ndarray:
    frame.wait()
    not_finite, *needed = frame.told.tolist()
    if any(need > room for need, room in zip(needed, frame.rooms, strict=True)):
        return _come(frame.again())
    if not_finite:
        raise ResultError(NOT_FINITE)
    return frame.pixels.numpy()


def _to_host(values: Tensor) -> Tensor:
    """Into memory that the card writes by itself, several times as fast, once it comes to it."""
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
