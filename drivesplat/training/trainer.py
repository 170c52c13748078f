"""The state of a training and its iteration: render one image, compare it, take a step."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.road_distance import Road
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, ModelStates, want_of
from drivesplat.settings.train import TrainSettings
from drivesplat.training.clock import UNTIMED, Clock
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.cuda_graph.image_inputs import SharedImageInputs, can_share
from drivesplat.training.cuda_graph.iteration_graphs import (
    GaussianCount,
    IterationGraphs,
    Recording,
    Terms,
    can_capture,
)
from drivesplat.training.cuda_graph.scan_inputs import SharedScanInputs
from drivesplat.training.densify import Densifier
from drivesplat.training.dropout import with_dropout
from drivesplat.training.losses import loss_terms, surface_terms
from drivesplat.training.mirroring import sets_with_mirrored_objects
from drivesplat.training.monitor import FiniteGuard, readable
from drivesplat.training.optimizers import (
    DeviceSchedule,
    ModelOptimizers,
    choose_learned,
    make_optimizers,
    set_fine_tuning_rates,
    set_learning_rates,
)
from drivesplat.training.scan_schedule import ScanSchedule
from drivesplat.training.scans import TrainingScan, scan_index, scan_terms
from drivesplat.training.views import TrainingView

MEASURED_SCANS = 8
"""Iterations with scans before one is captured: they measure the entries that the lists of any need."""


@dataclass
class Trainer:
    """The state of a training between two iterations. `settings.iterations` are those before it fine-tunes."""

    model: SplatModel
    images: TrainingImages
    settings: TrainSettings
    seed: int
    device: torch.device
    optimizers: ModelOptimizers
    densifiers: list[Densifier]
    guard: FiniteGuard
    road: Road | None
    clock: Clock
    graphs: IterationGraphs
    schedule: DeviceSchedule
    scan_schedule: ScanSchedule
    scans: list[TrainingScan]
    image_inputs: SharedImageInputs
    scan_inputs: SharedScanInputs = field(default_factory=SharedScanInputs)
    step: int = 0

    @classmethod
    def begin(
        cls,
        model: SplatModel,
        views: list[TrainingView],
        settings: TrainSettings,
        seed: int,
        device: torch.device,
        road: Road | None = None,
        clock: Clock = UNTIMED,
        scans: Sequence[TrainingScan] = (),
    ) -> "Trainer":
        torch.manual_seed(seed)
        schedule = ScanSchedule.of(settings, len(views), len(scans))
        settings = settings.model_copy(update={"iterations": schedule.fine_tuning_from})
        optimizers, known = make_optimizers(model), None if road is None else road.to(device)
        images, guard = TrainingImages(views, settings, seed), FiniteGuard(device)
        capture = clock is UNTIMED and can_capture(settings, images, device, len(scans))
        graphs, on_device = IterationGraphs(capture, device), DeviceSchedule(device)
        densifiers = [Densifier(part, settings, graphs.invalidate) for part in model.parts]
        model.precompute([scan.view.time for scan in scans], SCAN)
        return cls(
            model, images, settings, seed, device, optimizers, densifiers, guard, known, clock, graphs, on_device,
            schedule, list(scans), SharedImageInputs(images, model.exposure is not None),
        )  # fmt: skip

    @property
    def sensor_positions(self) -> Float[Tensor, "n 3"]:
        """The positions (world metres) of the training cameras, without images those of the LiDAR, in the order of the
        recordings."""
        cameras = [view.view.camera_to_world[:3, 3] for view in self.images.views]
        return torch.stack(cameras or [scan.view.sensor_to_world[:3, 3] for scan in self.scans])

    @property
    def iterations(self) -> int:
        """The number of all iterations, with those that fit scans."""
        return self.scan_schedule.steps

    @property
    def fits_scan(self) -> bool:
        """Whether the next iteration fits a scan, unless a picture is wanted of it and there are images."""
        return self.scan_schedule.fits_scan(self.step)

    @property
    def fine_tunes(self) -> bool:
        """Whether the next iteration fine-tunes what only the LiDAR sees: it fits a scan and changes no image."""
        return self.scan_schedule.fine_tunes(self.step)

    def training_step(self, with_picture: bool = True) -> tuple[Terms, Picture | None, TrainingView | None]:
        """The first half of an iteration: render a view or a scan, compare, step. Returns its loss terms, the picture
        and the view, both None after a scan. Without `with_picture` the iteration may be that of a scan or a replayed
        CUDA graph, and the picture is None; without images, and where it fine-tunes, it is that of a scan."""
        choose_learned(self.optimizers, self.fine_tunes)
        self._set_learning_rates()
        step, rates = self.schedule.update(self.step, self.optimizers)
        if self.fits_scan and (self.fine_tunes or not (with_picture and self.images.views)):
            return self._fit_scan(step, rates), None, None
        with self.clock.stage("data"):
            number, view = self.images.number(self._images_done), self.images.at(self.step, self._images_done)
        if with_picture or not self.graphs.enabled:
            return *self.graphs.retry_without_graphs(lambda: self._image_step(view, step, rates)), view
        return self._replay_image(number, view, step, rates), None, view

    def _replay_image(
        self, number: int, view: TrainingView, step: int | Tensor, rates: Mapping[str, Tensor] | None
    ) -> Terms:
        """An iteration with an image, by its CUDA graph or the one for all of its shape, where there is one."""
        factor, shared = self.images.factor(self.step), can_share(view)
        layout = factor, self.sh_degree(), *self._addresses()
        if not shared:
            alone = Recording("image", (factor, number))
            return self._captured(alone, lambda: self._image_step(view, step, rates)[0], layout)
        states = self.model.states(view.view.time)
        inputs = self.graphs.retry_without_graphs(lambda: self.image_inputs.load(view, states))
        image = Recording("image", inputs.number, self.image_inputs.measured)
        return self._captured(image, lambda: self._image_step(inputs.view, step, rates, inputs.states)[0], layout)

    def _fit_scan(self, step: int | Tensor, rates: Mapping[str, Tensor] | None) -> Terms:
        """An iteration with the scan whose turn it is, by its CUDA graph where there is one."""
        number = scan_index(len(self.scans), self.scan_schedule.scans_before(self.step), self.seed)
        scan = self.scans[number]
        states = self.model.states(scan.view.time, SCAN)
        if not self.graphs.enabled:
            return self.graphs.retry_without_graphs(lambda: self._scan_step(scan, states, step, rates))
        inputs = self.graphs.retry_without_graphs(lambda: self.scan_inputs.load(scan, states))
        recording = Recording("scan", inputs.number, MEASURED_SCANS)
        layout = self.fine_tunes, *self._addresses()
        return self._captured(recording, lambda: self._scan_step(inputs.scan, inputs.states, step, rates), layout)

    def _set_learning_rates(self) -> None:
        if self.fine_tunes:
            set_fine_tuning_rates(self.model, self.optimizers, self.scan_schedule.fine_tuned(self.step))
        else:
            set_learning_rates(self.model, self.optimizers, self.step / self.settings.iterations, self.settings)

    def _captured(self, recording: Recording, iteration: Callable[[], Terms], layout: Hashable) -> Terms:
        """Runs an iteration with an image or a scan, by its CUDA graph where there is one of the same `layout`."""
        if not self.graphs.enabled:
            return self.graphs.retry_without_graphs(iteration)
        headroom = max(part.row_count / max(1, len(part)) for part in self.model.parts)
        gaussians = GaussianCount(len(self.model), headroom)
        return self.graphs.run(recording, layout, gaussians, iteration)

    def _image_step(
        self,
        view: TrainingView,
        step: int | Tensor,
        rates: Mapping[str, Tensor] | None,
        states: ModelStates | None = None,
    ) -> tuple[Terms, Picture]:
        """An iteration with a view; `states` are those of its time (None: to be looked up). `step` and `rates` are
        those of `DeviceSchedule.update`; a replay of this reads the values that they hold then."""
        stage, by_gradient = self.clock.stage, self.settings.strategy == "default"
        self.model.zero_grad()  # gradients of an iteration that ran out of memory
        with stage("render"):
            want = want_of(self.model.seen_from(view.view))
            states = self.model.states(view.view.time, want) if states is None else states
            sets = sets_with_mirrored_objects(self.model, states, want)
            if self.settings.dropout:
                sets = with_dropout(sets, self.model, self.settings.dropout)
            picture = self.model.render(
                view.view,
                self.sh_degree(),
                gaussians=sets,
                with_depth=view.lidar is not None or self.settings.smoothness_weight > 0,
                with_objects=self.settings.entropy_weight > 0 and not by_gradient,
            )
        with stage("loss"):
            terms = loss_terms(picture, view, self.model, self.settings)
            terms |= surface_terms(picture.sets, self.model, self.road, self.settings)
        if by_gradient:
            picture.info["means2d"].retain_grad()
        return self._backward_and_update(terms, step, rates), picture

    def _scan_step(
        self,
        scan: TrainingScan,
        states: ModelStates,
        step: int | Tensor,
        rates: Mapping[str, Tensor] | None,
    ) -> Terms:
        """An iteration with a scan, as `_image_step`; `states` are those of its time."""
        stage, settings = self.clock.stage, self.settings.scans
        self.model.zero_grad()
        with stage("render"):
            before = (scan.range - settings.sight_margin).clamp(min=0.0) if settings.sight_weight else None
            picture = self.model.scan(scan.view, gaussians=self.model.sample(states, SCAN), before=before)
        with stage("loss"):
            terms = scan_terms(picture, scan, self.model, self.settings)
            if not self.images.views:
                terms |= surface_terms(picture.sets, self.model, self.road, self.settings)
        return self._backward_and_update(terms, step, rates, self._limit_gradients)

    def _backward_and_update(
        self,
        terms: Terms,
        step: int | Tensor,
        rates: Mapping[str, Tensor] | None,
        limit_gradients: Callable[[], None] = lambda: None,
    ) -> Terms:
        """The step down the gradient of the sum of the terms, limited by `limit_gradients`; returns the terms without
        gradients."""
        stage = self.clock.stage
        with stage("backward"):
            torch.stack(list(terms.values())).sum().backward()
            limit_gradients()
        with stage("optimizer"):
            watched = self.optimizers.step(rates)
        with stage("checks"):
            losses = {f"loss {name}": value for name, value in terms.items()}
            gradients = {f"gradient of {readable(name, self.model)}": value for name, value in watched.items()}
            self.guard.watch(step, losses | gradients)
        return {name: value.detach() for name, value in terms.items()}

    def _limit_gradients(self) -> None:
        """Multiplies a scan's gradients of geometry and of shared parameters by `scans.geometry`. While a training
        fine-tunes these have no gradients (`choose_learned`)."""
        for part in self.model.parts:
            geometry = [*(part.params[name] for name in part.geometry), *part.shared.values()]
            _scale_gradients(geometry, self.settings.scans.geometry)

    @property
    def _images_done(self) -> int:
        """The number of iterations so far that fitted an image."""
        return self.scan_schedule.images_before(self.step)

    def _addresses(self) -> tuple[tuple[int, int], ...]:
        """The addresses and sizes of all parameters. Captured iterations become invalid when they change."""
        return tuple((parameter.data_ptr(), parameter.numel()) for parameter in self.model.parameters())

    def checks_due(self) -> bool:
        """Whether to check this iteration: those that may add, move or remove Gaussians, and as often later on."""
        return any(densifier.due(self.step) for densifier in self.densifiers)

    def densify(self, picture: Picture | None) -> None:
        """The second half of an iteration: unless it fine-tunes, each part adds, removes and relocates Gaussians."""
        info = {} if picture is None else picture.info
        parts = zip(self.densifiers, self.optimizers.parts, self.model.rows, strict=True)
        for densifier, optimizers, rows in () if self.fine_tunes else parts:
            densifier.after_step(self.step, optimizers, info, rows, self.images.factor(self.step) > 1)
        self.step += 1

    def end(self) -> None:
        """Drops preallocated rows, and lets gradients reach all that was learned: another training may follow."""
        for _, optimizer in self.optimizers.all():
            optimizer.parameter.requires_grad_(True)
        for densifier, optimizers in zip(self.densifiers, self.optimizers.parts, strict=True):
            densifier.end(optimizers)

    def sh_degree(self) -> int:
        every = max(1, int(self.settings.sh_every * self.settings.iterations))
        return min(self.step // every, max(part.sh_degree for part in self.model.parts))


def _scale_gradients(parameters: Iterable[Tensor], factor: float) -> None:
    """Multiplies gradients by a factor; at 0 there are none."""
    for parameter in parameters:
        if parameter.grad is not None and factor != 1.0:
            parameter.grad = parameter.grad.mul_(factor) if factor else None
