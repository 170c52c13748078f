"""Training steps called as `drivesplat.training.step.eager_step`, but captured as CUDA graphs and replayed where they
can be: Python launches one graph in place of a thousand kernels.

At 640x360 the GPU runs an iteration's hundreds of kernels faster than Python can launch them. A graph keeps the
addresses of what it reads and writes, so it belongs to the inputs that images or LiDAR scans of one shape are copied
into (`drivesplat.training.graphs.inputs`), or to one image, and stays valid while the model's tensors keep their
addresses: preallocated rows let the number of Gaussians grow meanwhile. A graph is captured after the first runs have
shown how many entries its lists need.
"""

import logging
import operator
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import torch

from drivesplat.kernels import capacity, cuda_graphs
from drivesplat.kernels.cuda_graphs import CudaGraph, MemoryPool, capture, graphs_supported, new_pool
from drivesplat.model.picture import Picture
from drivesplat.model.states import IMAGE, SCAN
from drivesplat.settings.train import TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.graphs.inputs import SharedImageInputs, SharedScanInputs, can_share
from drivesplat.training.losses import Terms
from drivesplat.training.scans import TrainingScan
from drivesplat.training.step import UNTIMED, TrainingState, eager_step, image_step, scan_step
from drivesplat.training.views import TrainingView

MEASURED_SCANS = 8
"""Steps with scans before one is captured: they measure the entries that the lists of any need."""
log = logging.getLogger(__name__)
T = TypeVar("T")
MAX_RECORDINGS = 4096
"""A training with more images and scans captures nothing. Graphs of images read cached time states, up to three for
each image, and scans use as many; four times MAX_RECORDINGS are cached, so that none is replaced."""
REMEMBERED = 0.8
"""Part of the entries needed before that a shared graph keeps when it is captured again: perhaps not every scan was
replayed since."""


@dataclass(frozen=True)
class Recording:
    """What an iteration fits: an image, or any image or LiDAR scan of one shape, by its `index` among those of its
    `kind`. It is captured after so many `runs`, which measure the entries that its lists need."""

    kind: str
    index: Hashable
    runs: int = 1


@dataclass(frozen=True)
class GaussianCount:
    """The number of Gaussians `now`, and the factor `headroom` by which it can grow before tensors are reallocated."""

    now: int
    headroom: float


@dataclass
class IterationGraphs:
    """The CUDA graphs of a training's iterations, by recording; none where they are not `enabled`."""

    enabled: bool
    device: torch.device
    _layouts: dict[str, Hashable] = field(default_factory=dict)
    """By kind of recording, the layout of its graphs."""
    _needs: dict[Recording, list[float]] = field(default_factory=dict)
    """By recording, the most entries per Gaussian that each of its lists has needed."""
    _runs: Counter[Recording] = field(default_factory=Counter)
    """By recording, the number of runs without a graph."""
    _graphs: dict[Recording, CudaGraph[Terms]] = field(default_factory=dict)
    _count: int = 1
    _pool: MemoryPool | None = None

    def run(
        self, recording: Recording, layout: Hashable, gaussians: GaussianCount, iteration: Callable[[], Terms]
    ) -> Terms:
        """Runs an iteration with a recording, by its graph where there is one. The graphs of a kind of recordings are
        invalid once their `layout` changes."""
        if not self.enabled:
            return iteration()
        if layout != self._layouts.get(recording.kind):
            self._drop([other for other in self._graphs if other.kind == recording.kind])
            self._layouts[recording.kind] = layout
        self._count = max(1, gaussians.now)
        graph = self._graphs.get(recording)
        if graph is None and self._runs[recording] >= recording.runs:
            graph = self._capture(recording, self._count * gaussians.headroom, iteration)
        if graph is None:
            with capacity.exact() as needs:
                terms = self.retry_without_graphs(iteration)
            now = [need / self._count for need in needs]
            self._needs[recording] = [*map(max, now, self._needs.get(recording, now))]
            self._runs[recording] += 1
            return terms
        graph.replay()
        return graph.result

    def retry_without_graphs(self, work: Callable[[], T]) -> T:
        """Runs `work`; where memory runs out, again without graphs, which are then no longer `enabled`."""
        return cuda_graphs.retry_without_graphs(work, self._drop_all)

    def _drop_all(self) -> bool:
        """Disables graphs; returns False where there are none."""
        if not self._graphs:
            return False
        log.warning("no GPU memory is left for CUDA graphs: training takes longer without them; lower train.cap_max")
        self._disable()
        return True

    def check(self) -> None:
        """Drops the graphs whose lists overflowed, to be captured with more capacity. Waits for the device."""
        if not self._graphs:
            return
        overflowed = [
            recording
            for recording, most in self._most_needed([*self._graphs]).items()
            if any(map(operator.gt, most, self._graphs[recording].capacities))
        ]
        if overflowed:
            log.debug("lists of %d CUDA graphs overflowed", len(overflowed))
        self._drop(overflowed)

    def invalidate(self) -> bool:
        """Drops all graphs since tensors are about to be reallocated; returns whether any will be captured again."""
        self._drop(list(self._graphs))
        return self.enabled

    def _drop(self, recordings: Sequence[Recording]) -> None:
        """Drops graphs and remembers the most entries that their lists needed. Waits for the device."""
        if not recordings:
            return
        for recording, most in self._most_needed(recordings).items():
            now = [need / self._count for need in most]
            if recording.runs > 1:
                now = [max(need, REMEMBERED * old) for need, old in zip(now, self._needs[recording], strict=True)]
            self._needs[recording] = now
            del self._graphs[recording]
        if not self._graphs:
            self._pool = None  # torch frees it with the last graph

    def _most_needed(self, recordings: Sequence[Recording]) -> dict[Recording, list[int]]:
        """The most entries that each list of some graphs has needed. Waits for the device once."""
        graphs = [self._graphs[recording] for recording in recordings]
        most = torch.cat([graph.most for graph in graphs]).cpu().split([len(graph.most) for graph in graphs])
        return {recording: needs.tolist() for recording, needs in zip(recordings, most, strict=True)}

    def _disable(self) -> None:
        """Drops all graphs; none will be captured any more."""
        self.enabled = False
        if self._graphs:
            torch.cuda.synchronize(self.device)
        self._graphs.clear()
        self._pool = None

    def _capture(
        self, recording: Recording, gaussians: float, iteration: Callable[[], Terms]
    ) -> CudaGraph[Terms] | None:
        """The graph of an iteration with lists for so many Gaussians; the capture does not run it. Where the GPU or its
        driver refuses, returns None and disables graphs."""
        self._pool = self._pool or new_pool()
        expected = [int(need * gaussians) for need in self._needs[recording]]
        graph = capture(iteration, expected, self._pool, self.device, "iterations")
        if graph is None:
            self._disable()
        else:
            self._graphs[recording] = graph
        return graph


@dataclass
class CapturedSteps:
    """The steps of a training with `images`: they decide about the inputs of graphs, their capture and replay. Without
    enabled `graphs` every step is eager."""

    graphs: IterationGraphs
    images: TrainingImages
    image_inputs: SharedImageInputs
    scan_inputs: SharedScanInputs = field(default_factory=SharedScanInputs)

    @classmethod
    def of(cls, state: TrainingState, images: TrainingImages, scans: int, device: torch.device) -> "CapturedSteps":
        """For a training with so many scans. A clock sees no stages within a graph: what is timed is not captured."""
        enabled = state.clock is UNTIMED and can_capture(state.schedule.settings, images, device, scans)
        inputs = SharedImageInputs(images, state.model.exposure is not None)
        return cls(IterationGraphs(enabled, device), images, inputs)

    def __call__(
        self, state: TrainingState, target: TrainingView | TrainingScan, with_picture: bool = True
    ) -> tuple[Terms, Picture | None]:
        """As `eager_step`. Without `with_picture` the step with an image may be a replay, which gives no picture."""
        if isinstance(target, TrainingScan):
            return self._scan_step(state, target), None
        if with_picture or not self.graphs.enabled:
            return self.graphs.retry_without_graphs(lambda: eager_step(state, target))
        return self._image_step(state, target), None

    def _image_step(self, state: TrainingState, image: TrainingView) -> Terms:
        """Fits an image, by its CUDA graph or the one for all of its shape, where there is one."""
        model, factor = state.model, self.images.factor(state.step)
        layout = factor, state.sh_degree, *_addresses(state)
        if not can_share(image):
            alone = Recording("image", (factor, self.images.number(state.step)))
            return self._run(state, alone, layout, lambda: image_step(state, image)[0])
        states = model.states(image.view.time, IMAGE)
        inputs = self.graphs.retry_without_graphs(lambda: self.image_inputs.load(image, states))
        shared = Recording("image", inputs.number, self.image_inputs.measured)
        return self._run(state, shared, layout, lambda: image_step(state, inputs.view, inputs.states)[0])

    def _scan_step(self, state: TrainingState, scan: TrainingScan) -> Terms:
        """Fits a scan, by the CUDA graph for all of its shape, where there is one."""
        if not self.graphs.enabled:
            return self.graphs.retry_without_graphs(lambda: scan_step(state, scan))
        states = state.model.states(scan.view.time, SCAN)
        inputs = self.graphs.retry_without_graphs(lambda: self.scan_inputs.load(scan, states))
        shared = Recording("scan", inputs.number, MEASURED_SCANS)
        layout = state.schedule.fine_tunes(state.step), *_addresses(state)
        return self._run(state, shared, layout, lambda: scan_step(state, inputs.scan, inputs.states))

    def _run(self, state: TrainingState, recording: Recording, layout: Hashable, step: Callable[[], Terms]) -> Terms:
        """Runs a step, by its CUDA graph where there is one of the same `layout`."""
        if not self.graphs.enabled:
            return self.graphs.retry_without_graphs(step)
        headroom = max(part.row_count / max(1, len(part)) for part in state.model.parts)
        return self.graphs.run(recording, layout, GaussianCount(len(state.model), headroom), step)


def _addresses(state: TrainingState) -> tuple[tuple[int, int], ...]:
    """The addresses and sizes of all parameters. Captured steps become invalid when they change."""
    return tuple((parameter.data_ptr(), parameter.numel()) for parameter in state.model.parameters())


def can_capture(settings: TrainSettings, images: TrainingImages, device: torch.device, scans: int = 0) -> bool:
    """Whether iterations of a training, with so many LiDAR `scans`, can and shall be captured. Densification by
    gradient reads intermediate results of an iteration; class logits have too many values for lists of planned
    capacity."""
    few = len(images.views) + scans <= MAX_RECORDINGS
    wanted = settings.cuda_graphs and settings.strategy == "mcmc" and few
    return wanted and graphs_supported(device) and all(view.classes is None for view in images.views)
