"""Training steps called as `drivesplat.training.step.eager_step`, but replayed as CUDA graphs where they can be."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import torch

from drivesplat.model.picture import Picture
from drivesplat.model.states import IMAGE, SCAN
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.graphs.inputs import SharedImageInputs, SharedScanInputs, can_share
from drivesplat.training.graphs.iteration_graphs import GaussianCount, IterationGraphs, Recording, can_capture
from drivesplat.training.losses import Terms
from drivesplat.training.scans import TrainingScan
from drivesplat.training.step import UNTIMED, TrainingState, eager_step, image_step, scan_step
from drivesplat.training.views import TrainingView

MEASURED_SCANS = 8
"""Steps with scans before one is captured: they measure the entries that the lists of any need."""


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
