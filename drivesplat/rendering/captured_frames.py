"""A film's frames as a GPU is asked for them: without waiting for it, and, where nothing changes but the camera and the
time, by replaying one CUDA graph.

A frame is some hundred kernels, which Python asks for in 2 to 4 ms and the GPU does in less. Captured once they are had
for a few copies: of the camera and of what its time means to the parts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from drivesplat.kernels import capacity as rooms
from drivesplat.kernels import triton as on_gpu
from drivesplat.kernels.cuda_graphs import Graph, captured, fresh_pool, own_stream
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.color_bytes import nearest_bytes

Shown = tuple[View, Gaussians | None]
"""A view, and the Gaussians that stand in for those that the model has at its time (None: none do)."""
Moments = Sequence[Sequence[Tensor]]
"""What a time means to each part of a model."""


@dataclass(frozen=True)
class Frame:
    """A frame's `pixels`, and whether its colours were `finite`."""

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
        return _outgrown(self.needed.tolist(), self.rooms)


class FramesOnGpu:
    """A model on a GPU, which is asked for frames: for the first it says how much room its lists of Gaussians need, the
    others get that and a margin. The second is captured, and with those that follow replayed, but for frames with
    Gaussians of their own or of a camera of the rig. The model must not change meanwhile."""

    def __init__(self, model: SplatModel):
        self._model = model
        self._needs: list[int] | None = None  # of the lists of one frame: the most of each; None before the first
        self._graph: _FrameGraph | None = None
        self._captures = on_gpu.compiles()

    def asked(self, shown: Shown) -> Asked:
        """A frame that was asked for."""
        return self._beside_graph(self._by_itself if self._needs is None else self._in_a_row, shown)

    @torch.no_grad()
    def _beside_graph(self, ask: Callable[[Shown], Asked], shown: Shown) -> Asked:
        """A frame as `ask` has it; where memory does not suffice beside what is captured, nothing is any more."""
        try:
            return ask(shown)
        except torch.cuda.OutOfMemoryError:
            if self._graph is None:
                raise
        self._graph, self._captures = None, False
        torch.cuda.empty_cache()
        return ask(shown)

    def _in_a_row(self, shown: Shown) -> Asked:
        """A frame whose lists have as much room as those before it needed, and more."""
        view, gaussians = shown
        moments = self._moments(view) if gaussians is None else None
        if moments is not None and (graph := self._graph_of(view, moments)) is not None:
            made = graph.replayed(view, moments)
            return self._on_its_way(made.result, made.needed, made.rooms, shown)
        with rooms.given(self._needs) as lists:
            frame = _frame(self._model, view, gaussians)
        needs = [needed.int() for needed, _ in lists]
        needed = torch.stack(needs) if needs else torch.empty(0, dtype=torch.int32)
        return self._on_its_way(frame, needed, [room for _, room in lists], shown)

    def _by_itself(self, shown: Shown) -> Asked:
        """A frame with all the room it needs, for which the device is waited for; those that follow have as much."""
        with rooms.counted() as needs:
            frame = _frame(self._model, *shown)
        self._needs = [max(pair) for pair in zip(needs, self._needs or needs, strict=True)]
        if self._graph is not None and _outgrown(needs, self._graph.graph.rooms):
            self._graph = None
        return self._on_its_way(frame, torch.empty(0, dtype=torch.int32), [], shown)

    def _moments(self, view: View) -> Moments | None:
        """What a view's time means to the parts; None where a frame of it cannot be captured: where cameras of the rig
        were, and how they expose, goes by Python."""
        return self._model.time_states(view.time) if self._captures and view.camera is None else None

    def _graph_of(self, view: View, moments: Moments) -> "_FrameGraph | None":
        """What serves for a view, captured now unless it was before; None where the GPU or its driver refuses."""
        if self._graph is None or not self._graph.serves(view):
            self._graph = None  # its memory is free for the one that follows
            self._graph = _FrameGraph.of(self._model, view, moments, self._needs)
            self._captures = self._graph is not None
        return self._graph

    def _on_its_way(self, frame: Frame, needed: Tensor, room: Sequence[int], shown: Shown) -> Asked:
        come = torch.cuda.Event()
        there = Frame(_to_host(frame.pixels), _to_host(frame.finite))
        needed = _to_host(needed)
        come.record()
        return Asked(there, needed, room, come.synchronize, lambda: self._beside_graph(self._by_itself, shown))


@dataclass(frozen=True)
class _FrameGraph:
    """A frame of a view and of moments, which lie where those of other frames are copied to."""

    view: View
    moments: Moments
    graph: Graph[Frame]

    @classmethod
    def of(cls, model: SplatModel, view: View, moments: Moments, needs: Sequence[int]) -> "_FrameGraph | None":
        """That of a model, whose lists needed so many entries; None where the GPU or its driver refuses."""
        device = view.K.device
        own_view = replace(view, K=view.K.clone(), camera_to_world=view.camera_to_world.clone())
        own_moments = [[values.clone() for values in moment] for moment in moments]

        def once() -> Frame:
            return _frame(model, own_view, model.gaussians_at_time_states(own_moments))

        pool = fresh_pool()
        with own_stream(device):  # films are made beside a thread that encodes them
            graph = captured(once, needs, pool, device, "frames of films", errors="thread_local")
        return None if graph is None else cls(own_view, own_moments, graph)

    def serves(self, view: View) -> bool:
        """Whether a view is of the same size."""
        return (view.width, view.height) == (self.view.width, self.view.height)

    def replayed(self, view: View, moments: Moments) -> Graph[Frame]:
        """The graph, asked for what a view shows at moments."""
        self.view.K.copy_(view.K)
        self.view.camera_to_world.copy_(view.camera_to_world)
        for own, moment in zip(self.time_states, moments, strict=True):
            for place, values in zip(own, moment, strict=True):
                place.copy_(values)
        self.graph.replay()
        return self.graph


def _frame(model: SplatModel, view: View, gaussians: Gaussians | None) -> Frame:
    """What a view shows, on the device."""
    image = model.render(view, gaussians=gaussians).image
    return Frame(nearest_bytes(image), torch.isfinite(image).all())


def _outgrown(needs: Sequence[int], room: Sequence[int]) -> bool:
    """Whether a list needs more entries than it has room for."""
    return any(need > its for need, its in zip(needs, room, strict=True))


def _to_host(values: Tensor) -> Tensor:
    """Into memory that the card writes by itself, several times as fast, once it comes to it."""
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
