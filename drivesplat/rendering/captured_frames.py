"""Frames of films on a GPU, rendered without host synchronisation and, where only camera and time change, by replaying
one CUDA graph.

Python takes 2 to 4 ms to launch the hundred kernels of a frame, longer than the GPU takes to run them. A replay costs a
few copies: of the camera, and of the parts' states.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Int, UInt8
from torch import Tensor

from drivesplat.kernels import capacity, triton_support
from drivesplat.kernels.cuda_graphs import CudaGraph, capture, capture_stream, new_pool, retry_without_graphs
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ModelStates, copied, tensors_of
from drivesplat.model.view import View
from drivesplat.rendering.color_bytes import to_uint8

FrameInput = tuple[View, Gaussians | Sequence[Gaussians] | None]
"""A view, and the Gaussians to render in place of the model's own at its time (None: the model's own)."""


@dataclass(frozen=True)
class RenderedFrame:
    """A frame's `pixels`, and whether its colours were `finite`."""

    pixels: UInt8[Tensor, "h w 3"]
    finite: Bool[Tensor, ""]


@dataclass(frozen=True)
class PendingFrame:
    """A frame that the device is rendering. After `wait` the `frame` is in main memory, as are the numbers of entries
    that its lists `needed`, of their `capacities`. `retry` renders it with exact capacities."""

    frame: RenderedFrame
    needed: Int[Tensor, " lists"]
    capacities: Sequence[int]
    wait: Callable[[], None]
    retry: Callable[[], "PendingFrame"]

    @property
    def overflowed(self) -> bool:
        """Whether Gaussians are missing since a list needed more than its capacity."""
        return _overflowed(self.needed.tolist(), self.capacities)


class GpuFrameRenderer:
    """Renders frames of a model on a GPU. The first frame measures the entries that its lists of Gaussians need; later
    frames get capacities of that and a margin. The second frame is captured as a CUDA graph and replayed for those that
    follow, except for frames with Gaussians of their own or of a camera of the rig. The model must not change
    meanwhile."""

    def __init__(self, model: SplatModel):
        self._model = model
        self._needs: list[int] | None = None  # the most entries that each list of a frame needed; None before the first
        self._graph: _FrameGraph | None = None
        self._captures = triton_support.compiles()

    def submit(self, wanted: FrameInput) -> PendingFrame:
        """Starts rendering a frame."""
        return self._retry_without_graph(self._measured if self._needs is None else self._planned, wanted)

    @torch.no_grad()
    def _retry_without_graph(self, render: Callable[[FrameInput], PendingFrame], wanted: FrameInput) -> PendingFrame:
        """Runs `render`; where memory runs out, again without a graph, and none is captured any more."""
        return retry_without_graphs(partial(render, wanted), self._drop_graph)

    def _drop_graph(self) -> bool:
        """Stops capturing; returns False where there is no graph."""
        if self._graph is None:
            return False
        self._graph, self._captures = None, False
        return True

    def _planned(self, wanted: FrameInput) -> PendingFrame:
        """A frame with planned capacities, by the entries that earlier frames needed."""
        view, gaussians = wanted
        # of a camera of the rig, Python looks up its pose, exposure and rolling shutter: such frames are not captured
        captured = self._captures and gaussians is None and view.camera is None and view.shutter is None
        states = self._model.states(view.time) if captured else ()
        if captured and (self._graph is None or not self._graph.fits(view)):
            self._graph = None  # frees its memory for the next one
            self._graph = _FrameGraph.capture(self._model, view, states, self._needs)
            self._captures = self._graph is not None  # not where the GPU or its driver refuses
        if captured and self._graph is not None:
            graph = self._graph.replay(view, states)
            return self._pending(graph.result, graph.needed, graph.capacities, wanted)
        with capacity.planned(self._needs) as lists:
            frame = _render(self._model, view, gaussians)
        needs = [needed.int() for needed, _ in lists]
        needed = torch.stack(needs) if needs else torch.empty(0, dtype=torch.int32)
        return self._pending(frame, needed, [capacity for _, capacity in lists], wanted)

    def _measured(self, wanted: FrameInput) -> PendingFrame:
        """A frame with exact capacities, which later frames get too. Waits for the device."""
        with capacity.exact() as needs:
            frame = _render(self._model, *wanted)
        self._needs = [max(pair) for pair in zip(needs, self._needs or needs, strict=True)]
        if self._graph is not None and _overflowed(needs, self._graph.graph.capacities):
            self._graph = None
        return self._pending(frame, torch.empty(0, dtype=torch.int32), [], wanted)

    def _pending(
        self, frame: RenderedFrame, needed: Tensor, capacities: Sequence[int], wanted: FrameInput
    ) -> PendingFrame:
        copied = torch.cuda.Event()
        on_host = RenderedFrame(_to_host(frame.pixels), _to_host(frame.finite))
        needed = _to_host(needed)
        copied.record()
        retry = partial(self._retry_without_graph, self._measured, wanted)
        return PendingFrame(on_host, needed, capacities, copied.synchronize, retry)


@dataclass(frozen=True)
class _FrameGraph:
    """The graph of a frame, and its inputs, into which those of other frames are copied."""

    view: View
    states: ModelStates
    graph: CudaGraph[RenderedFrame]

    @classmethod
    def capture(cls, model: SplatModel, view: View, states: ModelStates, needs: Sequence[int]) -> "_FrameGraph | None":
        """Captures a frame of a model whose lists needed so many entries; None where the GPU or its driver refuses."""
        device = view.K.device
        own_view = replace(view, K=view.K.clone(), camera_to_world=view.camera_to_world.clone())
        own_states = copied(states)

        def render() -> RenderedFrame:
            return _render(model, own_view, model.sample(own_states))

        pool = new_pool()
        with capture_stream(device):  # a second thread encodes the film meanwhile
            graph = capture(render, needs, pool, device, "frames of films", errors="thread_local")
        return None if graph is None else cls(own_view, own_states, graph)

    def fits(self, view: View) -> bool:
        """Whether a view has the same size."""
        return (view.width, view.height) == (self.view.width, self.view.height)

    def replay(self, view: View, states: ModelStates) -> CudaGraph[RenderedFrame]:
        """The graph, replayed with a view and time states."""
        self.view.K.copy_(view.K)
        self.view.camera_to_world.copy_(view.camera_to_world)
        for place, values in zip(tensors_of(self.states), tensors_of(states), strict=True):
            place.copy_(values)
        self.graph.replay()
        return self.graph


def _render(model: SplatModel, view: View, gaussians: Gaussians | Sequence[Gaussians] | None) -> RenderedFrame:
    """A frame of a view, on the device."""
    image = model.render(view, gaussians=gaussians).image
    return RenderedFrame(to_uint8(image), torch.isfinite(image).all())


def _overflowed(needs: Sequence[int], capacities: Sequence[int]) -> bool:
    """Whether a list needs more entries than its capacity."""
    return any(need > capacity for need, capacity in zip(needs, capacities, strict=True))


def _to_host(values: Tensor) -> Tensor:
    """An asynchronous copy into pinned memory, which is several times faster than into pageable memory."""
    return torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
