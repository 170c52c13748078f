"""A trained model from which many images are rendered, on a GPU by replaying CUDA graphs.

Python takes 2 to 4 ms to launch the hundred kernels of an image, longer than the GPU takes to run them. A replay costs
a few copies: of the camera, and of the Gaussians that move.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

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
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, Want, want_of
from drivesplat.model.view import View

MAX_GRAPHS = 4
"""The kinds of images whose graphs are kept: a kind is a size, a camera with an exposure of its own, ..."""


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


@dataclass(frozen=True)
class PendingImage:
    """An image that the device is rendering. The next image may overwrite `rendered`: work that reads it must be
    submitted before. `needed` are the numbers of entries that its lists of Gaussians needed, of their `capacities`;
    where one is exceeded, Gaussians are missing, and `retry` renders the image with exact capacities."""

    rendered: RenderedImage
    needed: Int[Tensor, " lists"]
    capacities: Sequence[int]
    retry: Callable[[], "PendingImage"]


def overflowed(needed: Sequence[int], capacities: Sequence[int]) -> bool:
    """Whether a list needed more entries than its capacity."""
    return any(entries > available for entries, available in zip(needed, capacities, strict=True))


class FixedModel:
    """A `model` whose parameters do not change any more.

    Gaussians that are the same at all times are sampled once. On a GPU, the first image of a kind measures the entries
    that its lists of Gaussians need; later ones get capacities of that and a margin. The second one is captured as a
    CUDA graph, which is replayed for those that follow.

    >>> fixed = FixedModel(model)
    >>> image = fixed.render(view, fixed.sample(view.time)).image
    """

    def __init__(self, model: SplatModel):
        self.model = model
        self._same: dict[tuple[bool, bool], dict[int, Gaussians]] = {}  # by what is wanted, then by number of the part
        self._kinds: list[_ImageKind] = []  # the one used last is the last
        self._pool: MemoryPool | None = None
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
        if with_surface_depth or not self._captures:
            return self._rendered(view, sets, with_surface_depth)
        pending = self.submit(view, sets)
        while overflowed(pending.needed.tolist(), pending.capacities):
            pending = pending.retry()
        return pending.rendered.copied()

    @torch.no_grad()
    def submit(self, view: View, sets: Sequence[Gaussians]) -> PendingImage:
        """Starts rendering on a GPU."""
        return self._without_graphs_if_full(partial(self._planned, view, sets))

    def _rendered(self, view: View, sets: Sequence[Gaussians], with_surface_depth: bool = False) -> RenderedImage:
        picture = self.model.render(view, gaussians=sets, with_surface_depth=with_surface_depth)
        return RenderedImage(picture.image, picture.alpha, picture.surface_depth)

    def _planned(self, view: View, sets: Sequence[Gaussians]) -> PendingImage:
        """An image with planned capacities, by the entries that earlier ones of its kind needed."""
        retry = partial(self._without_graphs_if_full, partial(self._measured, view, sets))
        kind = self._kind_of(view, sets)
        if kind is None:
            return self._measured(view, sets)
        self._kinds.sort(key=lambda other: other is kind)
        if kind.graph is None and self._captures:
            kind.graph = self._captured(kind)
            self._captures = kind.graph is not None  # not where the GPU or its driver refuses
        if kind.graph is not None:
            kind.replay(view, sets)
            return PendingImage(kind.graph.result, kind.graph.needed, kind.graph.capacities, retry)
        with capacity.planned(kind.needs) as lists:
            rendered = self._rendered(view, sets)
        needs = [needed.int() for needed, _ in lists]
        needed = torch.stack(needs) if needs else torch.empty(0, dtype=torch.int32)
        return PendingImage(rendered, needed, [available for _, available in lists], retry)

    def _measured(self, view: View, sets: Sequence[Gaussians]) -> PendingImage:
        """An image with exact capacities, which later ones of its kind get too. Waits for the device."""
        retry = partial(self._without_graphs_if_full, partial(self._measured, view, sets))
        with capacity.exact() as needs:
            rendered = self._rendered(view, sets)
        kind = self._kind_of(view, sets)
        if kind is not None:
            kind.needs = [max(pair) for pair in zip(needs, kind.needs, strict=True)]
            if kind.graph is not None and overflowed(needs, kind.graph.capacities):
                kind.graph = None
        else:
            shared = [own for same in self._same.values() for own in same.values()]
            self._kinds = [*self._kinds[1 - MAX_GRAPHS :], _ImageKind(view, sets, needs, shared)]
        return PendingImage(rendered, torch.empty(0, dtype=torch.int32), [], retry)

    def _kind_of(self, view: View, sets: Sequence[Gaussians]) -> "_ImageKind | None":
        """The known kind that an image is of; that to which the fewest Gaussians are copied."""
        known = [kind for kind in self._kinds if kind.has(view, sets)]
        return max(known, key=lambda kind: sum(kind.same), default=None)

    def _captured(self, kind: "_ImageKind") -> CudaGraph[RenderedImage] | None:
        """A graph of images of a kind; None where the GPU or its driver refuses. Graphs are replayed one after the
        other and their results copied before, so that they can share memory."""
        device = kind.view.K.device
        if self._pool is None:
            self._pool = new_pool()
        with capture_stream(device):  # a second thread may encode a film meanwhile
            work = partial(self._rendered, replace(kind.view), kind.sets)
            return capture(work, kind.needs, self._pool, device, "rendered images", errors="thread_local")

    def _without_graphs_if_full(self, render: Callable[[], PendingImage]) -> PendingImage:
        """Runs `render`; where memory runs out, again without graphs, and none is captured any more."""
        return retry_without_graphs(torch.no_grad()(render), self._drop_graphs)

    def _drop_graphs(self) -> bool:
        """Stops capturing; returns False where there is no graph."""
        dropped = any(kind.graph is not None for kind in self._kinds)
        if dropped:
            self._kinds, self._pool, self._captures = [], None, False
        return dropped


class _ImageKind:
    """Images that one graph renders: its inputs, into which those of other images are copied. `needs` are the most
    entries that each of their lists needed. Sets that are among `shared` are the same in all of them."""

    def __init__(
        self,
        view: View,
        sets: Sequence[Gaussians],
        needs: list[int],
        shared: Sequence[Gaussians],
    ):
        shutter = view.shutter
        if shutter is not None:
            shutter = replace(shutter, readout_s=shutter.readout_s.clone(), motion=shutter.motion.clone())
        own = {"K": view.K.clone(), "camera_to_world": view.camera_to_world.clone(), "seconds": view.moment.clone()}
        self.view = replace(view, **own, shutter=shutter)
        self.same = [any(one is other for other in shared) for one in sets]
        self.sets = [
            one if same else Gaussians(**{name: values.clone() for name, values in one.tensors.items()})
            for one, same in zip(sets, self.same, strict=True)
        ]
        self.needs = needs
        self.graph: CudaGraph[RenderedImage] | None = None

    def has(self, view: View, sets: Sequence[Gaussians]) -> bool:
        """Whether an image is of this kind."""
        return (
            (view.width, view.height, view.camera) == (self.view.width, self.view.height, self.view.camera)
            and (view.shutter is None) == (self.view.shutter is None)
            and len(sets) == len(self.sets)
            and all(
                one is own if same else _shapes(one) == _shapes(own)
                for one, own, same in zip(sets, self.sets, self.same, strict=True)
            )
        )

    def replay(self, view: View, sets: Sequence[Gaussians]) -> None:
        """Replays the graph with the inputs of an image."""
        assert self.graph is not None and self.view.seconds is not None
        self.view.K.copy_(view.K)
        self.view.camera_to_world.copy_(view.camera_to_world)
        self.view.seconds.fill_(view.time)
        if view.shutter is not None and self.view.shutter is not None:
            self.view.shutter.readout_s.copy_(view.shutter.readout_s)
            self.view.shutter.motion.copy_(view.shutter.motion)
        for one, own, same in zip(sets, self.sets, self.same, strict=True):
            if not same:
                for name, values in one.tensors.items():
                    own.tensors[name].copy_(values)
        self.graph.replay()


def _shapes(gaussians: Gaussians) -> dict[str, torch.Size]:
    return {name: values.shape for name, values in gaussians.tensors.items()}
