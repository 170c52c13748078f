"""A trained model from which many images and LiDAR scans are rendered, on a GPU by replaying CUDA graphs.

Python takes 2 to 4 ms to launch the hundred kernels of an image, longer than the GPU takes to run them; for a scan, 7
ms. A replay costs a few copies: of the sensor, and of the Gaussians that move.
"""

from collections.abc import Callable, Hashable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar
from weakref import ReferenceType, ref

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels import capacity
from drivesplat.kernels.cuda_graphs import (
    CudaGraph,
    MemoryPool,
    capture,
    capture_stream,
    graphs_supported,
    new_pool,
    retry_without_graphs,
)
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.scans import ScanPicture, ScanView, view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, Want, want_of
from drivesplat.model.view import View
from drivesplat.rasterization.scans import RayGrid
from drivesplat.scene.scan import ScanRays
from drivesplat.scene.scan_record import RecordedScan

MAX_GRAPHS = 12
"""The kinds of renderings whose graphs are kept: a kind is a size, a camera with an exposure of its own, the rays of a
LiDAR, ... A rig of more sensors than that, in turns, would have none: each would make place for the next."""


@dataclass(frozen=True)
class RenderedImage:
    """Colours in [0, 1] with the sky, how opaque the scene is without it, and the depth in metres along the camera's
    axis of the surfaces that are shown, 0 where there are none (None: not asked for)."""

    image: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    surface_depth: Float[Tensor, "h w"] | None = None

    def copied(self) -> "RenderedImage":
        """A copy of image and alpha in memory of their own."""
        return RenderedImage(self.image.clone(), self.alpha.clone())


Shown = TypeVar("Shown", RenderedImage, ScanPicture)
Sensor = TypeVar("Sensor", View, ScanView)
Rendering = Callable[[Sensor, Sequence[Gaussians]], Shown]


@dataclass(frozen=True)
class Pending(Generic[Shown]):
    """An image or a scan that the device is rendering. The next one may overwrite `rendered`: work that reads it must
    be submitted before. `needed` are the numbers of entries that its lists of Gaussians needed, of their `capacities`;
    where one is exceeded, Gaussians are missing, and `retry` renders it with exact capacities."""

    rendered: Shown
    needed: Int[Tensor, " lists"]
    capacities: Sequence[int]
    retry: Callable[[], "Pending[Shown]"]


def overflowed(needed: Sequence[int], capacities: Sequence[int]) -> bool:
    """Whether a list needed more entries than its capacity."""
    return any(entries > available for entries, available in zip(needed, capacities, strict=True))


class FixedModel:
    """A `model` whose parameters do not change any more.

    Gaussians that are the same at all times are sampled once. On a GPU, the first image or scan of a kind measures the
    entries that its lists of Gaussians need; later ones get capacities of that and a margin. The second one is captured
    as a CUDA graph, which is replayed for those that follow.

    >>> fixed = FixedModel(model)
    >>> image = fixed.render(view, fixed.sample(view.time)).image
    """

    def __init__(self, model: SplatModel):
        self.model = model
        self._same: dict[tuple[bool, bool], dict[int, Gaussians]] = {}  # by what is wanted, then by number of the part
        self._kinds: list[_RenderingKind] = []  # the one used last is the last
        self._pool: MemoryPool | None = None
        self._grids: list[tuple[ScanRays, RayGrid]] = []  # the one used last is the last
        self._captures = graphs_supported(model.parts[0].params["means"].device)

    @torch.no_grad()
    def sample(self, time: float, want: Want = IMAGE) -> list[Gaussians]:
        """The set of Gaussians of each part at a time in seconds since the first image: see `Part.sample`."""
        known = self._same.setdefault((want.colors, want.lidar), {})
        sets = []
        for number, (part, state) in enumerate(zip(self.model.parts, self.model.states(time, want), strict=True)):
            changes = part.has_objects or part.moves or bool(state.now)
            if changes or number not in known:
                sets.append(part.sample(state, want))
                if not changes:
                    known[number] = sets[-1]
            else:
                sets.append(known[number])
        return sets

    def sample_in(self, view: View) -> list[Gaussians]:
        """The Gaussians that a view shows, as recorded."""
        return self.sample(view.time, want_of(self.model.seen_from(view)))

    @torch.no_grad()
    def render(self, view: View, sets: Sequence[Gaussians], with_surface_depth: bool = False) -> RenderedImage:
        """Renders a set of Gaussians of each part. Waits for a GPU, so that no Gaussian is missing. The depth of
        surfaces is rendered without a graph, since it waits for the device."""
        if with_surface_depth:
            picture = self.model.render(view, gaussians=sets, with_surface_depth=True)
            return RenderedImage(picture.image, picture.alpha, picture.surface_depth)
        return self.render_all([(view, sets)])[0]

    @torch.no_grad()
    def render_all(self, wanted: Sequence[tuple[View, Sequence[Gaussians]]]) -> list[RenderedImage]:
        """Renders each view of its own set of Gaussians of each part, as `render` does. Waits for a GPU once for all of
        them."""
        return self._finished(wanted, self._image)

    def scan_view(self, sensor: RecordedScan, beam_spread: tuple[float, float]) -> ScanView:
        """The rays of a recorded scan as a view of the model. `beam_spread` in radians. What follows from rays alone is
        kept for further scans with the same."""
        rays, device = sensor.scan.rays, self.model.parts[0].params["means"].device
        known = next((grid for own, grid in self._grids if own is rays), None)
        view = view_of_scan(sensor, beam_spread, device, known)
        others = [pair for pair in self._grids if pair[0] is not rays]
        self._grids = [*others[1 - MAX_GRAPHS :], (rays, view.rays)]
        return view

    @torch.no_grad()
    def scan(self, view: ScanView, sets: Sequence[Gaussians]) -> ScanPicture:
        """What a LiDAR measures of a set of Gaussians of each part. Waits for a GPU. Raises ResultError for Gaussians
        of a model that was trained without LiDAR."""
        return self._finished([(view, sets)], self._scan)[0]

    @torch.no_grad()
    def submit(self, view: View, sets: Sequence[Gaussians]) -> Pending[RenderedImage]:
        """Starts rendering an image on a GPU."""
        return self._without_graphs_if_full(partial(self._planned, view, sets, self._image))

    def _image(self, view: View, sets: Sequence[Gaussians]) -> RenderedImage:
        picture = self.model.render(view, gaussians=sets)
        return RenderedImage(picture.image, picture.alpha)

    def _scan(self, view: ScanView, sets: Sequence[Gaussians]) -> ScanPicture:
        return self.model.scan(view, gaussians=sets)

    def _finished(
        self, wanted: Sequence[tuple[Sensor, Sequence[Gaussians]]], render: Rendering[Sensor, Shown]
    ) -> list[Shown]:
        """Renderings without missing Gaussians, in memory of their own."""
        if not self._captures or not wanted:
            return [render(view, sets) for view, sets in wanted]
        started = [self._started(view, sets, render) for view, sets in wanted]
        needs = torch.cat([one.needed for one in started]).cpu()  # waits for the GPU
        return [
            one.retry().rendered if overflowed(needed.tolist(), one.capacities) else one.rendered
            for one, needed in zip(started, needs.split([len(one.capacities) for one in started]), strict=True)
        ]

    def _started(self, view: Sensor, sets: Sequence[Gaussians], render: Rendering[Sensor, Shown]) -> Pending[Shown]:
        """A rendering that later ones do not overwrite."""
        pending = self._without_graphs_if_full(partial(self._planned, view, sets, render))
        return replace(
            pending, rendered=pending.rendered.copied(), needed=pending.needed.to(_inputs(view)[0].device, copy=True)
        )

    def _planned(self, view: Sensor, sets: Sequence[Gaussians], render: Rendering[Sensor, Shown]) -> Pending[Shown]:
        """A rendering with planned capacities, by the entries that earlier ones of its kind needed."""
        retry = partial(self._without_graphs_if_full, partial(self._measured, view, sets, render))
        kind = self._kind_of(view, sets)
        if kind is None:
            return self._measured(view, sets, render)
        self._kinds.sort(key=lambda other: other is kind)
        if kind.graph is None and self._captures:
            kind.graph = self._captured(kind, render)
            self._captures = kind.graph is not None  # not where the GPU or its driver refuses
        if kind.graph is not None:
            kind.replay(view, sets)
            return Pending(kind.graph.result, kind.graph.needed, kind.graph.capacities, retry)
        with capacity.planned(kind.needs) as lists:
            rendered = render(view, sets)
        needs = [needed.int() for needed, _ in lists]
        needed = torch.stack(needs) if needs else torch.empty(0, dtype=torch.int32)
        return Pending(rendered, needed, [available for _, available in lists], retry)

    def _measured(self, view: Sensor, sets: Sequence[Gaussians], render: Rendering[Sensor, Shown]) -> Pending[Shown]:
        """A rendering with exact capacities, which later ones of its kind get too. Waits for the device."""
        retry = partial(self._without_graphs_if_full, partial(self._measured, view, sets, render))
        with capacity.exact() as needs:
            rendered = render(view, sets)
        kind = self._kind_of(view, sets)
        if kind is not None:
            kind.needs = [max(pair) for pair in zip(needs, kind.needs, strict=True)]
            if kind.graph is not None and overflowed(needs, kind.graph.capacities):
                kind.graph = None
        else:
            shared = [own for same in self._same.values() for own in same.values()]
            self._kinds = [*self._kinds[1 - MAX_GRAPHS :], _RenderingKind(view, sets, needs, shared)]
        return Pending(rendered, torch.empty(0, dtype=torch.int32), [], retry)

    def _kind_of(self, view: View | ScanView, sets: Sequence[Gaussians]) -> "_RenderingKind | None":
        """The known kind of a rendering; that to which the fewest Gaussians are copied."""
        form = _form(view)
        known = [kind for kind in self._kinds if kind.has(form, sets)]
        return max(known, key=lambda kind: sum(kind.same), default=None)

    def _captured(self, kind: "_RenderingKind", render: Rendering[Any, Shown]) -> CudaGraph[Shown] | None:
        """A graph of renderings of a kind; None where the GPU or its driver refuses. Graphs are replayed one after the
        other and their results copied before, so that they can share memory."""
        device = _inputs(kind.view)[0].device
        if all(other.graph is None for other in self._kinds):
            self._pool = new_pool()  # torch frees a pool with its last graph
        with capture_stream(device):  # a second thread may encode a film meanwhile
            work = partial(render, replace(kind.view), kind.sets)
            return capture(work, kind.needs, self._pool, device, "renderings", errors="thread_local")

    def _without_graphs_if_full(self, render: Callable[[], Pending[Shown]]) -> Pending[Shown]:
        """Runs `render`; where memory runs out, again without graphs, and none is captured any more."""
        return retry_without_graphs(torch.no_grad()(render), self._drop_graphs)

    def _drop_graphs(self) -> bool:
        """Stops capturing; returns False where there is no graph."""
        dropped = any(kind.graph is not None for kind in self._kinds)
        if dropped:
            self._kinds, self._pool, self._captures = [], None, False
        return dropped


class _RenderingKind:
    """Renderings of one graph: its inputs, into which those of others are copied. `needs` are the most entries that
    each of their lists needed. Sets that are among `shared` are the same in all of them."""

    def __init__(self, view: View | ScanView, sets: Sequence[Gaussians], needs: list[int], shared: Sequence[Gaussians]):
        self.view, self.form = _copied(view), _form(view)
        self.same = [any(one is other for other in shared) for one in sets]
        self.sets = [
            one if same else Gaussians(**{name: values.clone() for name, values in one.tensors.items()})
            for one, same in zip(sets, self.same, strict=True)
        ]
        self.needs = needs
        self.graph: CudaGraph[Any] | None = None
        self._given: list[ReferenceType[Gaussians] | None] = [None] * len(sets)  # whose values are in `sets`

    def has(self, form: Hashable, sets: Sequence[Gaussians]) -> bool:
        """Whether a rendering of a view with this `_form` is of this kind."""
        return (
            form == self.form
            and len(sets) == len(self.sets)
            and all(
                one is own if same else _shapes(one) == _shapes(own)
                for one, own, same in zip(sets, self.sets, self.same, strict=True)
            )
        )

    def replay(self, view: View | ScanView, sets: Sequence[Gaussians]) -> None:
        """Replays the graph with the inputs of a rendering."""
        assert self.graph is not None
        for values, own in zip(_inputs(view), _inputs(self.view), strict=True):
            own.copy_(values)
        if isinstance(self.view, View) and self.view.seconds is not None:
            self.view.seconds.fill_(view.time)
        for i, (one, own, same) in enumerate(zip(sets, self.sets, self.same, strict=True)):
            given = self._given[i]
            if not (same or (given is not None and given() is one)):
                for values, into in zip(one.tensors.values(), own.tensors.values(), strict=True):
                    into.copy_(values)
                self._given[i] = ref(one)
        self.graph.replay()


def _inputs(view: View | ScanView) -> list[Tensor]:
    """The tensors of a sensor that a rendering reads, but for the time of an image, in a fixed order."""
    if isinstance(view, ScanView):
        return view.tensors
    shutter = [] if view.shutter is None else [view.shutter.readout_s, view.shutter.motion]
    return [view.K, view.camera_to_world, *shutter]


def _copied(view: View | ScanView) -> View | ScanView:
    """A copy with tensors of its own, among them all that follow from a scan's rays."""
    own: View | ScanView = deepcopy(view)
    _inputs(own)
    return own if isinstance(own, ScanView) else replace(own, seconds=own.moment.clone())


def _form(view: View | ScanView) -> Hashable:
    """Equal for views that one graph can render."""
    if isinstance(view, ScanView):
        return view.beam_spread, *((values.shape, values.dtype) for values in view.tensors)
    return view.width, view.height, view.camera, view.shutter is None


def _shapes(gaussians: Gaussians) -> dict[str, torch.Size]:
    return {name: values.shape for name, values in gaussians.tensors.items()}
