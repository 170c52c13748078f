"""The training loop: Gaussians fitted to the images and scans of a scene, with resume state, densification and logs."""

import logging
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.errors import TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.kernels.cuda_graphs import capture_stream
from drivesplat.kernels.road_distance import Road
from drivesplat.machine.device import device_name, explain_out_of_memory
from drivesplat.model.checkpoint import STATE
from drivesplat.model.picture import Picture
from drivesplat.model.reach import bound_positions, reach_of
from drivesplat.model.road import RoadPart
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN
from drivesplat.settings.train import TrainSettings
from drivesplat.training import resume_state
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.densify import Densifier
from drivesplat.training.floaters import EmptySpace, SensorPath, fade_in_empty_space
from drivesplat.training.graphs.captured_steps import CapturedSteps
from drivesplat.training.losses import Terms
from drivesplat.training.monitor import FiniteGuard, Monitor, camera_figures
from drivesplat.training.optimizers import DeviceSchedule, ParameterAverage, make_optimizers
from drivesplat.training.probes import NO_PROBES, CurveImage, Probes, curve_psnrs
from drivesplat.training.scans import TrainingScan, scan_index
from drivesplat.training.schedule import Schedule
from drivesplat.training.step import ITERATION, UNTIMED, Clock, TrainingState
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

BOUND_EVERY = 100
"""Steps between those after which positions are bounded. The last one before the fine-tuning is one of them."""
MAX_UNSAVED_S = 60.0
"""Seconds of training after which a resume state is saved between the iterations that settings name."""


@dataclass(frozen=True)
class TrainingFolders:
    """The folders of a training's resume state and TensorBoard log.

    No rule declares `resume`; `fingerprint` is that of settings, code and inputs, `label` that of the progress bar.
    `describe` writes into `resume`, after each state, what makes a model of it.
    """

    resume: Path
    tensorboard: Path
    fingerprint: str
    label: str
    describe: Callable[[Path], None] = lambda _: None

    @property
    def state(self) -> Path:
        return self.resume / STATE


@dataclass(frozen=True)
class TrainingSummary:
    """The content of `train.json`.

    `iterations` are those that `train.iterations` counts, and `scan_iterations` those that fitted a LiDAR scan.
    `peak_gpu_memory_gb` is torch's peak reservation, None on the CPU; `seconds` includes the runs before a resume;
    `of_cameras` are the learned gains and offsets of each camera, by name.
    """

    iterations: int
    scan_iterations: int
    seconds: float
    gaussians: int
    peak_gpu_memory_gb: float | None
    device: str
    random_seed: int
    resumed_at: list[int]
    of_cameras: dict[str, float]


def train(
    model: SplatModel,
    views: list[TrainingView],
    settings: TrainSettings,
    seed: int,
    device: torch.device,
    folders: TrainingFolders,
    road: Road | None = None,
    clock: Clock = UNTIMED,
    curves: Sequence[CurveImage] = (),
    scans: Sequence[TrainingScan] = (),
    probes: Probes = NO_PROBES,
) -> TrainingSummary:
    """Fits `model` in place to `views` and LiDAR `scans`, resuming an interrupted run of the same training; `clock`
    times its stages. `road` is the surface of the road (None: unknown or not wanted). `curves` are the images of PSNR
    curves in TensorBoard; `probes` see the model during the training.

    Raises TrainingError where a loss or gradient is not finite or no Gaussian is left, DeviceError where the GPU's
    memory is exhausted. The last good checkpoint survives both.
    """
    with explain_out_of_memory(lambda: len(model)), capture_stream(device):
        trainer = Trainer.begin(model.to(device), views, settings, seed, device, road, clock, scans)
        run = TrainingRun.begin(trainer, folders, curves, probes)
        with Monitor(folders.tensorboard, trainer.schedule.steps, trainer.state.step, folders.label) as monitor:
            if not trainer.state.step:
                parts = ", ".join(part.name for part in model.parts)
                told = {"parts": parts, "random_seed": seed, **settings.model_dump(mode="json")}
                monitor.hyperparameters(told, [name for image in curves for name in image.curves])
            _iterate(run, monitor)
        return run.summary()


def _iterate(run: "TrainingRun", monitor: Monitor) -> None:
    trainer, state, schedule = run.trainer, run.trainer.state, run.trainer.schedule
    settings, sensors = schedule.settings, trainer.sensor_positions
    driven = SensorPath.of(sensors, settings.floaters.radius) if settings.floaters.radius else None
    road_part = next((part for part in state.model.parts if isinstance(part, RoadPart)), None)
    empty = EmptySpace(driven, state.road if settings.floaters.below_road else None, road_part)
    reach = math.inf if settings.max_distance is None else reach_of(sensors, settings.max_distance)
    while state.step < schedule.steps:
        with state.clock.stage(ITERATION):
            with_picture = _due(state.step + 1, settings.image_every, schedule.fine_tuning_from)
            terms, picture, image = trainer.training_step(with_picture)
            with state.clock.stage("densification"):
                _densify(run, picture, empty)
                if run.average.update(state.step, state.model):
                    _confine(state.model)  # in the mean, Gaussians that were faded meanwhile are visible again
                    fade_in_empty_space(state.model.parts, empty)
                if math.isfinite(reach) and _due(state.step, BOUND_EVERY, schedule.fine_tuning_from):
                    for part in state.model.parts:
                        bound_positions(part, reach)
            if state.step % settings.log_every == 0:
                run.check()
                monitor.scalars(state.step, _scalars(terms, state.model), settings.log_every)
            monitor.progress(state.step, terms)
            if with_picture and picture is not None and image is not None:
                monitor.image(state.step, image, run.without_dropout(picture, image))
            monitor.write(state.step, run.psnrs())
            run.probe()
            if run.save_due:
                run.save()
    run.check()
    trainer.end()


def _due(step: int, every: int, last: int) -> bool:
    """Whether something is done after so many steps: every now and then, and after the `last`."""
    return step % every == 0 or step == last


def _densify(run: "TrainingRun", picture: Picture | None, empty: EmptySpace) -> None:
    """Ends an iteration: checks it; unless it fine-tunes, densifies each part and fades Gaussians in empty space."""
    trainer, state, floaters = run.trainer, run.trainer.state, run.trainer.schedule.settings.floaters
    fine_tunes = trainer.schedule.fine_tunes(state.step)
    if any(densifier.due(state.step) for densifier in trainer.densifiers):
        run.check()  # NaN in a strategy triggers a GPU assertion, after which the process cannot continue
        trainer.steps.graphs.check()
        if not fine_tunes:
            _confine(state.model)
    trainer.densify(picture)
    if len(state.model) == 0:
        run.check()
    if not fine_tunes and state.step % floaters.every == 0:
        fade_in_empty_space(state.model.parts, empty)


def _confine(model: SplatModel) -> None:
    """Fades Gaussians where their parts must not have any, as outside the boxes of objects."""
    for part in model.parts:
        part.confine()


def _scalars(terms: Terms, model: SplatModel) -> dict[str, float]:
    losses = {f"loss/{name}": float(value) for name, value in terms.items()}
    return {"loss/total": sum(losses.values()), **losses, "gaussians": float(len(model)), **camera_figures(model)}


@dataclass
class Trainer:
    """A training in memory, between two iterations: its `state`, the `images` and `scans` that its steps fit, the steps
    themselves, eager or captured, and the densification of each part."""

    state: TrainingState
    images: TrainingImages
    scans: list[TrainingScan]
    seed: int
    device: torch.device
    densifiers: list[Densifier]
    steps: CapturedSteps

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
        schedule, known = Schedule.of(settings, len(views), len(scans)), None if road is None else road.to(device)
        optimizers, guard = make_optimizers(model), FiniteGuard(device)
        state = TrainingState(model, schedule, optimizers, DeviceSchedule(device), guard, known, clock)
        images = TrainingImages(views, schedule, seed)
        steps = CapturedSteps.of(state, images, len(scans), device)
        densifiers = [Densifier(part, schedule, steps.graphs.invalidate) for part in model.parts]
        model.precompute([scan.view.time for scan in scans], SCAN)
        return cls(state, images, list(scans), seed, device, densifiers, steps)

    @property
    def schedule(self) -> Schedule:
        return self.state.schedule

    @property
    def sensor_positions(self) -> Float[Tensor, "n 3"]:
        """The positions (world metres) of the training cameras, without images those of the LiDAR, in the order of the
        recordings."""
        cameras = [view.view.camera_to_world[:3, 3] for view in self.images.views]
        return torch.stack(cameras or [scan.view.sensor_to_world[:3, 3] for scan in self.scans])

    def training_step(self, with_picture: bool = True) -> tuple[Terms, Picture | None, TrainingView | None]:
        """The first half of an iteration: a step. Returns its loss terms, the picture and the image, both None after a
        scan. Without `with_picture` the step may be a replay of a CUDA graph, and the picture is None."""
        self.state.begin_step()
        with self.state.clock.stage("data"):
            target = self._target(with_picture)
        terms, picture = self.steps(self.state, target, with_picture)
        return terms, picture, target if isinstance(target, TrainingView) else None

    def _target(self, with_picture: bool) -> TrainingView | TrainingScan:
        """What the next step fits: an image, or the scan whose turn it is. A step of which a picture is wanted fits an
        image, unless it fine-tunes or there are none."""
        schedule, step = self.schedule, self.state.step
        picture_possible = with_picture and schedule.images and not schedule.fine_tunes(step)
        if schedule.fits_scan(step) and not picture_possible:
            return self.scans[scan_index(len(self.scans), schedule.scans_before(step), self.seed)]
        return self.images.at(step)

    def densify(self, picture: Picture | None) -> None:
        """The second half of an iteration: unless it fine-tunes, each part adds, removes and relocates Gaussians."""
        state, info = self.state, {} if picture is None else picture.info
        parts = zip(self.densifiers, state.optimizers.parts, state.model.rows, strict=True)
        for densifier, optimizers, rows in () if self.schedule.fine_tunes(state.step) else parts:
            densifier.after_step(state.step, optimizers, info, rows, self.images.factor(state.step) > 1)
        state.step += 1

    def end(self) -> None:
        """Drops preallocated rows, and lets gradients reach all that was learned: another training may follow."""
        for _, optimizer in self.state.optimizers.all():
            optimizer.parameter.requires_grad_(True)
        for densifier, optimizers in zip(self.densifiers, self.state.optimizers.parts, strict=True):
            densifier.end(optimizers)


@dataclass
class TrainingRun:
    """A training and its state on disk."""

    trainer: Trainer
    folders: TrainingFolders
    seconds_before: float
    resumed_at: list[int]
    began: float
    saved: float
    """When the state was last saved, or else when this run began (`time.monotonic`, as `began`)."""
    curves: Sequence[CurveImage]
    probes: Probes
    average: ParameterAverage

    @classmethod
    def begin(
        cls, trainer: Trainer, folders: TrainingFolders, curves: Sequence[CurveImage], probes: Probes
    ) -> "TrainingRun":
        """Resumes from the state in `folders` if this training wrote it; otherwise starts at 0."""
        if trainer.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(trainer.device)
        average, state = ParameterAverage.of(trainer.schedule), trainer.state
        saved = resume_state.resumable(folders.state, folders.fingerprint)
        if saved is None:
            shutil.rmtree(folders.tensorboard, ignore_errors=True)
            return cls(trainer, folders, 0.0, [], now := time.monotonic(), now, curves, probes, average)
        resume_state.restore(saved["state"], state.model, state.optimizers, trainer.densifiers, trainer.device)
        state.step = saved["step"]
        average.restore(saved["average"], trainer.device)
        log.info("resuming at iteration %d of %d", state.step, trainer.schedule.steps)
        now = time.monotonic()
        resumed_at = [*saved["resumed_at"], state.step]
        return cls(trainer, folders, saved["seconds"], resumed_at, now, now, curves, probes, average)

    @property
    def seconds(self) -> float:
        """Training time so far, including earlier runs."""
        return self.seconds_before + time.monotonic() - self.began

    def check(self) -> None:
        """Raises TrainingError where something was not finite, or no Gaussian is left."""
        state = self.trainer.state
        state.guard.check(str(self.folders.state), lambda: [id for p in state.model.parts for id in p.broken_tracks()])
        if not any(densifier.any_alive() for densifier in self.trainer.densifiers):
            raise TrainingError(
                f"iteration {state.step + 1}: no Gaussian is left; "
                "lower train.opacity_reg or the thresholds of the densification"
            )

    def save(self) -> None:
        """Writes the resume state, unless a check fails."""
        self.check()
        trainer, state = self.trainer, self.trainer.state
        content = {
            "fingerprint": self.folders.fingerprint,
            "step": state.step,
            "seconds": self.seconds,
            "resumed_at": self.resumed_at,
            "state": resume_state.state_of(state.model, state.optimizers, trainer.densifiers, trainer.device),
            "average": self.average.state(),
        }
        checkpoint_file.save(self.folders.state, content)
        self.folders.describe(self.folders.resume)
        self.saved = time.monotonic()

    def psnrs(self) -> dict[str, float]:
        """The PSNRs of the curves where they are due, otherwise none."""
        state, every = self.trainer.state, self.trainer.schedule.settings.psnr_every
        if not every or not _due(state.step, every, self.trainer.schedule.steps):
            return {}
        graphs = self.trainer.steps.graphs
        return graphs.retry_without_graphs(lambda: curve_psnrs(state.model, self.curves, state.sh_degree))

    def without_dropout(self, picture: Picture, image: TrainingView) -> Picture:
        """The picture of an iteration, or another one of its image where dropout left out some of its Gaussians."""
        state = self.trainer.state
        if not self.trainer.schedule.settings.dropout:
            return picture
        with torch.no_grad():
            graphs = self.trainer.steps.graphs
            return graphs.retry_without_graphs(lambda: state.model.render(image.view, state.sh_degree))

    def probe(self) -> None:
        """Stops for a probe where one is due. The stop does not count as training."""
        trainer, state = self.trainer, self.trainer.state
        if not self.probes.due(state.step, trainer.schedule.steps):
            return
        if trainer.device.type == "cuda":
            torch.cuda.synchronize(trainer.device)
        seconds = self.seconds
        stopped = trainer.steps.graphs.retry_without_graphs(lambda: self.probes.stop(state.step, seconds, state.model))
        self.began, self.saved = self.began + stopped, self.saved + stopped

    @property
    def save_due(self) -> bool:
        """Whether to save the resume state now: every `checkpoint_every` iterations, and after slow ones every
        MAX_UNSAVED_S, but not sooner than settings allow; after the last iteration the checkpoint is saved instead."""
        step, settings = self.trainer.state.step, self.trainer.schedule.settings
        age = time.monotonic() - self.saved
        due = step % settings.checkpoint_every == 0 or age >= MAX_UNSAVED_S
        return due and step < self.trainer.schedule.steps and age >= settings.min_checkpoint_interval_s

    def summary(self) -> TrainingSummary:
        trainer, state, on_gpu = self.trainer, self.trainer.state, self.trainer.device.type == "cuda"
        if on_gpu:
            torch.cuda.synchronize(trainer.device)
        return TrainingSummary(
            iterations=trainer.schedule.iterations_before(state.step),
            scan_iterations=trainer.schedule.scans_before(state.step),
            seconds=self.seconds,
            gaussians=len(state.model),
            peak_gpu_memory_gb=torch.cuda.max_memory_reserved(trainer.device) / 1e9 if on_gpu else None,
            device=device_name(trainer.device),
            random_seed=trainer.seed,
            resumed_at=self.resumed_at,
            of_cameras=camera_figures(state.model),
        )
