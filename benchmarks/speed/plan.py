"""The trainings of a speed file, and the files that Snakemake prepares for them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from benchmarks.files import read_file
from benchmarks.snakemake_run import ConfigLayers, SnakemakeRun
from benchmarks.speed.settings import SpeedFile
from drivesplat.errors import ConfigError
from drivesplat.settings.config import load
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.method import with_seed
from drivesplat.settings.train import TrainJob
from drivesplat.workflow.stages import stage_settings


@dataclass(frozen=True)
class SceneFiles:
    """The scene's files that a training and its evaluation read."""

    scene: str
    parser: str
    masks: str
    actors: tuple[str, ...]
    lidar_depth: tuple[str, ...]
    scans: tuple[str, ...] = ()

    def all(self) -> list[str]:
        return [self.scene, self.parser, self.masks, *self.actors, *self.lidar_depth, *self.scans]


@dataclass(frozen=True)
class Task:
    """A training and its evaluation: `stage`, `train` and `code` are the inputs of the rule `train` for the method,
    length and seed, `evaluate` is the job of the rule `evaluate`. Output goes to `folder`; reduced images lie in
    `images`."""

    recipe: str
    stage: str
    train: TrainJob
    code: str
    evaluate: EvaluateJob
    device: DeviceSettings
    files: SceneFiles
    folder: Path
    images: Path
    workers: int
    visits: int

    @property
    def iterations(self) -> int:
        return self.train.train.iterations

    @property
    def seed(self) -> int:
        return self.train.random_seed

    @property
    def label(self) -> str:
        """Its name on the console."""
        return f"{self.recipe}, {self.iterations:,} iterations, seed {self.seed}"


def read_speed_file(path: str | Path, options: Mapping[str, Any]) -> SpeedFile:
    """The content of a speed file, with the command's options in place of its own values. Raises ConfigError, in one
    line that names the file, if it is missing or invalid."""
    return read_file(path, SpeedFile, "docs/speed.md", options)


def plan_run(file: SpeedFile, out: Path, workflow: Path) -> SnakemakeRun:
    """The Snakemake run of the method, each length and seed as a method of its own, with results below `out`;
    `workflow` is the Snakefile's folder. Raises ConfigError if the settings are invalid or know no such scene or
    method."""
    layers = ConfigLayers.of(file, workflow)
    known = load(layers.values).methods
    if file.method not in known:
        raise ConfigError(f"method {file.method!r} is not in the config; there are: {', '.join(known)}")
    lengths = {
        name_of(file.method, n): known[file.method].varied(None, {"train": {"iterations": n}}) for n in file.iterations
    }
    return SnakemakeRun.of(layers, file, lengths, out / "scene", workflow)


def name_of(method: str, iterations: int) -> str:
    """The name of a method trained for so many iterations."""
    return f"{method}-{iterations}"


def files_for(run: SnakemakeRun, method: str) -> SceneFiles:
    """The files that a method's training and evaluation read."""
    plan, at = run.plan, SimpleNamespace(scene=run.scene, method=method)
    folder = run.folder / run.scene
    return SceneFiles(
        plan.scene(at),
        str(folder / "parser.npz"),
        str(folder / "masks/masks.json"),
        tuple(plan.training_input("actors")(at)),
        tuple(plan.training_input("lidar_depth")(at)),
        tuple(plan.training_input("scans")(at)),
    )


def targets_of(run: SnakemakeRun) -> list[str]:
    """The files that Snakemake prepares before any training."""
    methods = [with_seed(name, seed) for name in run.methods for seed in run.seeds]
    return list(dict.fromkeys(path for method in methods for path in files_for(run, method).all()))


def tasks_of(file: SpeedFile, run: SnakemakeRun, out: Path) -> Iterator[Task]:
    """All recipes for each length and seed; their order alternates."""
    for iterations in file.iterations:
        for turn, seed in enumerate(file.seeds):
            for recipe in file.recipes if turn % 2 == 0 else file.recipes[::-1]:
                yield _task(file, run, out, (recipe, iterations, seed))


def _task(file: SpeedFile, run: SnakemakeRun, out: Path, which: tuple[str, int, int]) -> Task:
    recipe, iterations, seed = which
    method = with_seed(name_of(file.method, iterations), seed)
    config, at = run.plan.config, SimpleNamespace(scene=run.scene, method=method)
    return Task(
        recipe,
        f"{method}/train",
        TrainJob.model_validate_json(stage_settings(config, "train", run.scene, method)),
        run.plan.code("train"),
        EvaluateJob.model_validate_json(stage_settings(config, "evaluate", run.scene, method)),
        DeviceSettings.model_validate_json(run.plan.device(at)),
        files_for(run, method),
        out / "trainings" / with_seed(f"{recipe}-{iterations}", seed),
        out / "images",
        file.workers,
        file.visits,
    )
