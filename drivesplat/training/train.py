"""The training loop: Gaussians fitted to the training images of a scene, with resume state and logs."""

import logging
import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import torch

from drivesplat.errors import TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.kernels.cuda_graphs import capture_stream
from drivesplat.kernels.road_distance import Road
from drivesplat.machine.device import device_name, explain_out_of_memory
from drivesplat.model.picture import Picture
from drivesplat.model.reach import bound_positions, reach_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import TrainSettings
from drivesplat.training import resume_state
from drivesplat.training.averaging import ParameterAverage
from drivesplat.training.clock import ITERATION, UNTIMED, Clock
from drivesplat.training.floaters import EmptySpace, SensorPath, fade_in_empty_space
from drivesplat.training.monitor import Monitor, camera_figures
from drivesplat.training.probes import NO_PROBES, Probes
from drivesplat.training.psnr_curves import CurveViews, curve_psnrs
from drivesplat.training.scans import TrainingScan
from drivesplat.training.trainer import Trainer
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

BOUND_EVERY = 100
"""Iterations between steps that bound positions. The last iteration ends with one, too."""
MAX_UNSAVED_S = 60.0
"""Seconds of training after which a resume state is saved between the iterations that settings name."""


@dataclass(frozen=True)
class TrainingFolders:
    """The folders of a training's resume state and TensorBoard log.

    No rule declares `resume`; `fingerprint` is that of settings, code and inputs, `label` that of the progress bar.
    """

    resume: Path
    tensorboard: Path
    fingerprint: str
    label: str

    @property
    def state(self) -> Path:
        return self.resume / "state.npz"


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
    curves: CurveViews = MappingProxyType({}),
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
        with Monitor(folders.tensorboard, trainer.iterations, trainer.step, folders.label) as monitor:
            _iterate(run, monitor)
        return run.summary()


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
    curves: CurveViews
    probes: Probes
    average: ParameterAverage

    @classmethod
    def begin(cls, trainer: Trainer, folders: TrainingFolders, curves: CurveViews, probes: Probes) -> "TrainingRun":
        """Resumes from the state in `folders` if this training wrote it; otherwise starts at 0."""
        if trainer.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(trainer.device)
        average = ParameterAverage.of(trainer.settings)
        saved = resume_state.resumable(folders.state, folders.fingerprint)
        if saved is None:
            shutil.rmtree(folders.tensorboard, ignore_errors=True)
            return cls(trainer, folders, 0.0, [], now := time.monotonic(), now, curves, probes, average)
        resume_state.restore(saved["state"], trainer.model, trainer.optimizers, trainer.densifiers, trainer.device)
        trainer.step = saved["step"]
        average.restore(saved["average"], trainer.device)
        log.info("resuming at iteration %d of %d", trainer.step, trainer.iterations)
        now = time.monotonic()
        resumed_at = [*saved["resumed_at"], trainer.step]
        return cls(trainer, folders, saved["seconds"], resumed_at, now, now, curves, probes, average)

    @property
    def seconds(self) -> float:
        """Training time so far, including earlier runs."""
        return self.seconds_before + time.monotonic() - self.began

    def check(self) -> None:
        """Raises TrainingError where something was not finite, or no Gaussian is left."""
        parts = self.trainer.model.parts
        self.trainer.guard.check(str(self.folders.state), lambda: [id for part in parts for id in part.broken_tracks()])
        if not any(densifier.any_alive() for densifier in self.trainer.densifiers):
            raise TrainingError(
                f"iteration {self.trainer.step + 1}: no Gaussian is left; "
                "lower train.opacity_reg or the thresholds of the densification"
            )

    def save(self) -> None:
        """Writes the resume state, unless a check fails."""
        self.check()
        t = self.trainer
        content = {
            "fingerprint": self.folders.fingerprint,
            "step": t.step,
            "seconds": self.seconds,
            "resumed_at": self.resumed_at,
            "state": resume_state.state_of(t.model, t.optimizers, t.densifiers, t.device),
            "average": self.average.state(),
        }
        checkpoint_file.save(self.folders.state, content)
        self.saved = time.monotonic()

    def psnrs(self) -> dict[str, float]:
        """The PSNRs of the curves where they are due, otherwise none."""
        t, every = self.trainer, self.trainer.settings.psnr_every
        if not every or not _due(t.step, every, t.iterations):
            return {}
        return t.graphs.retry_without_graphs(lambda: curve_psnrs(t.model, self.curves, t.sh_degree()))

    def probe(self) -> None:
        """Stops for a probe where one is due. The stop does not count as training."""
        t = self.trainer
        if not self.probes.due(t.step, t.iterations):
            return
        if t.device.type == "cuda":
            torch.cuda.synchronize(t.device)
        seconds = self.seconds
        stopped = t.graphs.retry_without_graphs(lambda: self.probes.stop(t.step, seconds, t.model))
        self.began, self.saved = self.began + stopped, self.saved + stopped

    @property
    def save_due(self) -> bool:
        """Whether to save the resume state now: every `checkpoint_every` iterations, and after slow ones every
        MAX_UNSAVED_S, but not sooner than settings allow; after the last iteration the checkpoint is saved instead."""
        step, settings = self.trainer.step, self.trainer.settings
        age = time.monotonic() - self.saved
        due = step % settings.checkpoint_every == 0 or age >= MAX_UNSAVED_S
        return due and step < self.trainer.iterations and age >= settings.min_checkpoint_interval_s

    def summary(self) -> TrainingSummary:
        t, on_gpu = self.trainer, self.trainer.device.type == "cuda"
        if on_gpu:
            torch.cuda.synchronize(t.device)
        peak = torch.cuda.max_memory_reserved(t.device) / 1e9 if on_gpu else None
        return TrainingSummary(
            iterations=t.scan_schedule.counted_before(t.step),
            scan_iterations=t.scan_schedule.scans_before(t.step),
            seconds=self.seconds,
            gaussians=len(t.model),
            peak_gpu_memory_gb=peak,
            device=device_name(t.device),
            random_seed=t.seed,
            resumed_at=self.resumed_at,
            of_cameras=camera_figures(t.model),
        )


def _iterate(run: TrainingRun, monitor: Monitor) -> None:
    trainer, settings = run.trainer, run.trainer.settings
    sensors = trainer.sensor_positions
    below = trainer.road if settings.floaters.below_road else None
    driven = SensorPath.of(sensors, settings.floaters.radius) if settings.floaters.radius else None
    empty = EmptySpace(driven, below)
    reach = math.inf if settings.max_distance is None else reach_of(sensors, settings.max_distance)
    while trainer.step < trainer.iterations:
        with trainer.clock.stage(ITERATION):
            with_picture = _due(trainer.step + 1, settings.image_every, settings.iterations)
            terms, picture, view = trainer.training_step(with_picture)
            with trainer.clock.stage("densification"):
                _densify(run, picture, empty)
                if run.average.update(trainer.step, trainer.model):
                    _confine(trainer)  # in the mean, Gaussians that were faded meanwhile are visible again
                    fade_in_empty_space(trainer.model.parts, empty)
                _bound(trainer, reach)
            if trainer.step % settings.log_every == 0:
                run.check()
                monitor.scalars(trainer.step, _scalars(terms, trainer), settings.log_every)
            monitor.progress(trainer.step, terms)
            if with_picture and picture is not None and view is not None:
                monitor.image(trainer.step, view, _without_dropout(picture, view, trainer))
            monitor.psnrs(trainer.step, run.psnrs())
            run.probe()
            if run.save_due:
                run.save()
    run.check()
    trainer.end()


def _without_dropout(picture: Picture, view: TrainingView, trainer: Trainer) -> Picture:
    """The picture of an iteration, or another one of its view where dropout left out some of its Gaussians."""
    if not trainer.settings.dropout:
        return picture
    with torch.no_grad():
        return trainer.graphs.retry_without_graphs(lambda: trainer.model.render(view.view, trainer.sh_degree()))


def _due(step: int, every: int, iterations: int) -> bool:
    """Whether something is done after iteration `step` of so many: every now and then, and after the last."""
    return step % every == 0 or step == iterations


def _densify(run: TrainingRun, picture: Picture | None, empty: EmptySpace) -> None:
    """Ends an iteration: checks it; unless it fine-tunes, densifies each part and fades Gaussians in empty space."""
    trainer, settings = run.trainer, run.trainer.settings
    fine_tunes = trainer.fine_tunes
    if trainer.checks_due():
        run.check()  # NaN in a strategy triggers a GPU assertion, after which the process cannot continue
        trainer.graphs.check()
        if not fine_tunes:
            _confine(trainer)
    trainer.densify(picture)
    if len(trainer.model) == 0:
        run.check()
    if not fine_tunes and trainer.step % settings.floaters.every == 0:
        fade_in_empty_space(trainer.model.parts, empty)


def _confine(trainer: Trainer) -> None:
    """Fades Gaussians of objects outside their boxes."""
    for part in trainer.model.parts:
        part.confine()


def _bound(trainer: Trainer, reach: float) -> None:
    """Now and then moves Gaussians beyond `reach` metres back."""
    if math.isfinite(reach) and _due(trainer.step, BOUND_EVERY, trainer.settings.iterations):
        for part in trainer.model.parts:
            bound_positions(part, reach)


def _scalars(terms: dict[str, torch.Tensor], trainer: Trainer) -> dict[str, float]:
    losses = {f"loss/{name}": float(value) for name, value in terms.items()}
    of_cameras = camera_figures(trainer.model)
    return {"loss/total": sum(losses.values()), **losses, "gaussians": float(len(trainer.model)), **of_cameras}
