"""The stage `train`: Gaussians fitted to the training images of a scene."""

import logging
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from drivesplat.errors import TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.kernels.cuda_graphs import capture_stream
from drivesplat.machine.device import device_name, explain_out_of_memory
from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.settings.train import TrainSettings
from drivesplat.training import resume_state
from drivesplat.training.clock import ITERATION, UNTIMED, Clock
from drivesplat.training.floaters import EmptySpace, camera_path, fade_floaters
from drivesplat.training.geometry_priors import NO_PRIORS, GeometryPriors
from drivesplat.training.monitor import Monitor
from drivesplat.training.trainer import Trainer
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingFolders:
    """Where a training keeps what outlives it.

    `resume` is a folder no rule declares; `fingerprint` is that of settings, code and inputs.
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
    """What `train.json` says of a finished training.

    `peak_gpu_memory_gb`, what torch held at its peak, is None on the CPU; `seconds` counts resumed runs too;
    `of_cameras` has what was learned of each camera, by name: gains and offsets, how far poses were corrected.
    """

    iterations: int
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
    priors: GeometryPriors = NO_PRIORS,
    clock: Clock = UNTIMED,
) -> TrainingSummary:
    """Fits `model` in place, resuming where an earlier run of the same training was ended; `clock` times its stages.

    Raises TrainingError where a loss or gradient is not finite or no Gaussian is left, DeviceError where the GPU's
    memory is exhausted. The last good checkpoint survives both.
    """
    with explain_out_of_memory(lambda: len(model)), capture_stream(device):
        trainer = Trainer.begin(model.to(device), views, settings, seed, device, priors, clock)
        run = Run.begin(trainer, folders)
        with Monitor(folders.tensorboard, settings.iterations, trainer.step, folders.label) as monitor:
            _iterate(run, monitor)
        return run.summary()


@dataclass
class Run:
    """A training and its place on disk: what was done before this process, and what outlives it."""

    trainer: Trainer
    folders: TrainingFolders
    seconds_before: float
    resumed_at: list[int]
    began: float
    saved: float
    """When its state was last known on disk, or began (by `time.monotonic`, as `began`)."""

    @classmethod
    def begin(cls, trainer: Trainer, folders: TrainingFolders) -> "Run":
        """Takes up the folders's resume state if this training wrote it; otherwise starts at 0."""
        if trainer.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(trainer.device)
        saved = resume_state.resumable(folders.state, folders.fingerprint)
        if saved is None:
            shutil.rmtree(folders.tensorboard, ignore_errors=True)
            return cls(trainer, folders, 0.0, [], now := time.monotonic(), now)
        resume_state.restore(saved["state"], trainer.model, trainer.optimizers, trainer.densifiers, trainer.device)
        trainer.step = saved["step"]
        log.info("resuming at iteration %d of %d", trainer.step, trainer.settings.iterations)
        now = time.monotonic()
        return cls(trainer, folders, saved["seconds"], [*saved["resumed_at"], trainer.step], now, now)

    @property
    def seconds(self) -> float:
        """Training time so far, earlier processes included."""
        return self.seconds_before + time.monotonic() - self.began

    def check(self) -> None:
        """Raises TrainingError where something was not finite, or no Gaussian is left."""
        self.trainer.guard.check(str(self.folders.state))
        if not any(densifier.any_alive() for densifier in self.trainer.densifiers):
            raise TrainingError(
                f"iteration {self.trainer.step + 1}: no Gaussian is left; "
                "lower train.opacity_reg or the thresholds of the densification"
            )

    def save(self) -> None:
        """Writes the resume state, unless the training has gone wrong."""
        self.check()
        t = self.trainer
        content = {
            "fingerprint": self.folders.fingerprint,
            "step": t.step,
            "seconds": self.seconds,
            "resumed_at": self.resumed_at,
            "state": resume_state.state_of(t.model, t.optimizers, t.densifiers, t.device),
        }
        checkpoint_file.save(self.folders.state, content)
        self.saved = time.monotonic()

    @property
    def save_due(self) -> bool:
        """Whether the state is to be kept now: of the last iteration the training's own files are."""
        step, settings = self.trainer.step, self.trainer.settings
        apart = time.monotonic() - self.saved >= settings.checkpoint_apart_s
        return step % settings.checkpoint_every == 0 and step < settings.iterations and apart

    def summary(self) -> TrainingSummary:
        t, on_gpu = self.trainer, self.trainer.device.type == "cuda"
        if on_gpu:
            torch.cuda.synchronize(t.device)
        peak = torch.cuda.max_memory_reserved(t.device) / 1e9 if on_gpu else None
        return TrainingSummary(
            iterations=t.step,
            seconds=self.seconds,
            gaussians=len(t.model),
            peak_gpu_memory_gb=peak,
            device=device_name(t.device),
            random_seed=t.seed,
            resumed_at=self.resumed_at,
            of_cameras=learned_of_cameras(t.model),
        )


def _iterate(run: Run, monitor: Monitor) -> None:
    trainer, settings = run.trainer, run.trainer.settings
    path = camera_path(torch.stack([view.view.camera_to_world[:3, 3] for view in trainer.images.views]))
    empty = EmptySpace(*path, settings.floaters.radius, trainer.priors.free)
    while trainer.step < settings.iterations:
        with trainer.clock.stage(ITERATION):
            shown = (trainer.step + 1) % settings.image_every == 0
            terms, picture, view = trainer.fit_one(shown)
            with trainer.clock.stage("densification"):
                _densify(run, picture, empty)
            if trainer.step % settings.log_every == 0:
                run.check()
                monitor.scalars(trainer.step, _scalars(terms, trainer), settings.log_every)
            if shown and picture is not None:
                monitor.image(trainer.step, view, picture)
            if run.save_due:
                run.save()
    run.check()
    trainer.end()


def _densify(run: Run, picture: Picture | None, empty: EmptySpace) -> None:
    """Ends an iteration: each part grows and moves its Gaussians, and those that must not be there fade."""
    trainer, settings = run.trainer, run.trainer.settings
    if trainer.densifies():
        run.check()  # a strategy fed with what is no number ends in an assertion on the GPU, beyond rescue
        trainer.graphs.check()
        for part in trainer.model.parts:
            part.confine()
    trainer.densify(picture)
    if len(trainer.model) == 0:
        run.check()
    if empty.known and trainer.step % settings.floaters.every == 0:
        for part in (part for part in trainer.model.parts if not part.moves):
            fade_floaters(part, empty)


def _scalars(terms: dict[str, torch.Tensor], trainer: Trainer) -> dict[str, float]:
    losses = {f"loss/{name}": float(value) for name, value in terms.items()}
    of_cameras = learned_of_cameras(trainer.model)
    return {"loss/total": sum(losses.values()), **losses, "gaussians": float(len(trainer.model)), **of_cameras}


def learned_of_cameras(model: SplatModel) -> dict[str, float]:
    """What a model has learned of cameras, by name: 'exposure/CAM_BACK/gain_red', 'camera_poses/CAM_FRONT/shift_m'."""
    learned = {"exposure": model.exposure, "camera_poses": model.camera_poses}
    return {
        f"{kind}/{name}": value
        for kind, module in learned.items()
        if module is not None
        for name, value in module.figures().items()
    }
