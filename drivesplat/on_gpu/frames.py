"""A film's frames as a GPU is asked for them: without waiting for it, and, where nothing changes but the camera and the
time, by replaying one recording.

A frame is some hundred kernels, which Python asks for in 2 to 4 ms and the GPU does in less: recorded once, they are
had for the asking of seven copies.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from drivesplat import on_gpu
from drivesplat.frames import Shown, nearest_bytes
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.on_gpu import rooms
from drivesplat.on_gpu.recording import Recording, fresh_pool, own_stream, recorded


@dataclass(frozen=True)
class Frame:
    """A frame on the device: its `pixels`, and whether the colours were `finite`."""

    pixels: UInt8[Tensor, "h w 3"]
    finite: Bool[Tensor, ""]


@dataclass(frozen=True)
class Asked:
    """A frame that the device was asked for, in main memory after `wait`; how many entries its lists `needed`, there as
    well, of the `rooms` that they had; and how to ask for it `again`, with all the room it needs."""

    frame: Frame
    needed: Int[Tensor, " lists"]
    rooms: Sequence[int]
    wait: Callable[[], None]
    again: Callable[[], "Asked"]

    @property
    def cut_short(self) -> bool:
        """Whether Gaussians are missing for want of room."""
        return any(need > room for need, room in zip(self.needed.tolist(), self.rooms, strict=True))


class FramesOnGpu:
    """A model on a GPU, which is asked for frames: for the first it says how much room its lists of Gaussians need, the
    others get that and a margin; from the second on they are recorded. The model must not change meanwhile."""

    def __init__(self, model: SplatModel):
        self._model = model
        self._needs: list[int] | None = None
        self._film: _Film | None = None
        self._records = on_gpu.compiles()

    @torch.no_grad()
    def asked(self, shown: Shown) -> Asked:
        """A frame that was asked for."""
        view, gaussians = shown
        if self._needs is None:
            return self._by_itself(shown)
        film = self._film_of(view) if gaussians is None else None
        if film is not None:
            made = film.replayed(view, self._model.moments(view.time) or [])
            return self._on_its_way(made.result, made.needed, made.rooms, shown)
        with rooms.given(self._needs) as lists:
            frame = _frame(self._model, view, gaussians)
        needed = [needed.int() for needed, _ in lists]
        told = torch.stack(needed) if needed else torch.empty(0, dtype=torch.int32)
        return self._on_its_way(frame, told, [room for _, room in lists], shown)

    @torch.no_grad()
    def _by_itself(self, shown: Shown) -> Asked:
        """A frame with all the room it needs, for which the device is waited for; those that follow have as much."""
        with rooms.counted() as needs:
            frame = _frame(self._model, *shown)
        most = [max(pair) for pair in zip(needs, self._needs or needs, strict=True)]
        if most != self._needs:
            self._needs, self._film = most, None
        return self._on_its_way(frame, torch.empty(0, dtype=torch.int32), [], shown)

    def _film_of(self, view: View) -> "_Film | None":
        """The recording that serves for a view; None where there can be none."""
        if self._film is not None and self._film.serves(view):
            return self._film
        moments = self._model.moments(view.time)
        if not self._records or moments is None or view.camera is not None:  # corrections of a camera go by Python
            return None
        self._film = _Film.recorded(self._model, view, moments, self._needs or [])
        self._records = self._film is not None
        return self._film

    def _on_its_way(self, frame: Frame, needed: Tensor, room: Sequence[int], shown: Shown) -> Asked:
        come = torch.cuda.Event()
        there = Frame(_to_host(frame.pixels), _to_host(frame.finite))
        needed = _to_host(needed)
        come.record()
        return Asked(there, needed, room, come.synchronize, lambda: self._by_itself(shown))


@dataclass(frozen=True)
class _Film:
    """A recorded frame of a view and of moments of the model's parts, which lie where others are copied to."""

    view: View
    moments: Sequence[Sequence[Tensor]]
    recording: Recording[Frame]

    @classmethod
    def recorded(
        cls, model: SplatModel, view: View, moments: Sequence[Sequence[Tensor]], needs: Sequence[int]
    ) -> "_Film | None":
        """That of a model, whose lists needed so many entries; None where the GPU or its driver refuses."""
        device = view.K.device
        own_view = replace(view, K=view.K.clone(), camera_to_world=view.camera_to_world.clone())
        own_moments = [[values.clone() for values in moment] for moment in moments]

        def once() -> Frame:
            return _frame(model, replace(own_view), model.gaussians_in(own_moments))

        pool = fresh_pool()
        with own_stream(device):
            recording = recorded(once, needs, pool, device, "frames of films")
        return None if recording is None else cls(own_view, own_moments, recording)

    def serves(self, view: View) -> bool:
        """Whether a view is one of the recorded size by the reference's colours."""
        return (view.width, view.height, view.camera) == (self.view.width, self.view.height, self.view.camera)

    def replayed(self, view: View, moments: Sequence[Sequence[Tensor]]) -> Recording[Frame]:
        """The recording, asked for what a view shows at moments."""
        self.view.K.copy_(view.K)
        self.view.camera_to_world.copy_(view.camera_to_world)
        for own, moment in zip(self.moments, moments, strict=True):
            for place, values in zip(own, moment, strict=True):
                place.copy_(values)
        self.recording.replay()
        return self.recording


def _frame(model: SplatModel, view: View, gaussians: Gaussians | None) -> Frame:
    """What a view shows, on the device."""
    image = model.render(view, gaussians=gaussians).image
    return Frame(nearest_bytes(image), torch.isfinite(image).all())


def _to_host(values: Tensor) -> Tensor:
    """Into memory that the card writes by itself, several times as fast, once it comes to it."""
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
