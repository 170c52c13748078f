"""A file for `python -m benchmarks.speed` as the trainings that it asks for, and as what Snakemake makes for them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from benchmarks.quality.groups import SHARED, Group, layers_of, told_of
from benchmarks.speed.settings import SpeedFile
from drivesplat.errors import ConfigError
from drivesplat.settings import validated
from drivesplat.settings.config import load, require_known
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.method import with_seed, with_seeds
from drivesplat.settings.train import TrainJob
from drivesplat.settings.yaml_file import read_yaml
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings

DOCUMENT = "docs/speed.md"
RecipeName = Literal["plain", "ours"]
RECIPES: tuple[RecipeName, ...] = ("plain", "ours")


@dataclass(frozen=True)
class SceneFiles:
    """What Snakemake makes of the scene for a training and its measurement."""

    scene: str
    parser: str
    masks: str
    actors: tuple[str, ...]
    lidar_depth: tuple[str, ...]
    free_space: tuple[str, ...]

    def all(self) -> list[str]:
        return [self.scene, self.parser, self.masks, *self.actors, *self.lidar_depth, *self.free_space]


@dataclass(frozen=True)
class Task:
    """A training and its measurement, whole: `stage`, `train` and `code` are what the rule `train` gets for the method,
    length and seed, `evaluate` what the rule `evaluate` gets. What is written goes into `folder`; `images` is the
    folder of reduced images."""

    recipe: RecipeName
    stage: str
    train: TrainJob
    code: str
    evaluate: EvaluateJob
    device: DeviceSettings
    files: SceneFiles
    folder: Path
    images: Path
    workers: int

    @property
    def iterations(self) -> int:
        return self.train.train.iterations

    @property
    def seed(self) -> int:
        return self.train.random_seed

    @property
    def label(self) -> str:
        """What it is called while it runs."""
        return f"{self.recipe}, {self.iterations:,} iterations, seed {self.seed}"


def read_speed_file(path: str | Path, told: Mapping[str, Any]) -> SpeedFile:
    """The content of a file, with what the command was `told` in its place. Raises ConfigError, one line with the file,
    where it is missing or not what it should be."""
    content = read_yaml(path, "speed file")
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: a speed file holds a scene, lengths and seeds; {DOCUMENT} describes it")
    with told_of(str(path)):
        file = validated(SpeedFile, {**content, **told}, "", DOCUMENT)
        require_known(file.config, SHARED, "config")
    return file


def group_of(file: SpeedFile, out: Path, workflow: Path) -> Group:
    """The method with every length and seed as methods of one run of Snakemake, with results below `out`; `workflow` is
    the Snakefile's folder. Raises ConfigError where the settings are not valid or know no such scene or method."""
    layers = layers_of(file.base, file.config, file.scene, workflow)
    known = load(layers.values).methods
    if file.method not in known:
        raise ConfigError(f"method {file.method!r} is not in the config; there are: {', '.join(known)}")
    lengths = {
        name_of(file.method, n): known[file.method].varied(None, {"train": {"iterations": n}}) for n in file.iterations
    }
    methods = with_seeds(lengths, file.seeds)
    wanted = {name: method.model_dump(mode="json") for name, method in methods.items()}
    made = layers.under({"methods": dict.fromkeys(known) | wanted, "results_dir": str(out / "scene")})
    return Group(file.scene, file.seeds, tuple(lengths), Plan(made.values, str(workflow)), dict(made.laid))


def name_of(method: str, iterations: int) -> str:
    """What a method of so many iterations is called."""
    return f"{method}-{iterations}"


def files_for(group: Group, method: str) -> SceneFiles:
    """What a method's training and its measurement read."""
    plan, at = group.plan, SimpleNamespace(scene=group.scene, method=method)
    folder = group.folder / group.scene
    return SceneFiles(
        plan.scene(at),
        str(folder / "parser.pkl"),
        str(folder / "masks/masks.json"),
        tuple(plan.actors(at)),
        tuple(plan.lidar_depth(at)),
        tuple(plan.free_space(at)),
    )


def targets_of(group: Group) -> list[str]:
    """What Snakemake has to make before anything is trained."""
    methods = [with_seed(name, seed) for name in group.recipes for seed in group.seeds]
    return list(dict.fromkeys(path for method in methods for path in files_for(group, method).all()))


def tasks_of(file: SpeedFile, group: Group, out: Path) -> Iterator[Task]:
    """Length by length and seed by seed both recipes, which begin by turns."""
    for iterations in file.iterations:
        for turn, seed in enumerate(file.seeds):
            for recipe in RECIPES if turn % 2 == 0 else RECIPES[::-1]:
                yield _task(file, group, out, (recipe, iterations, seed))


def _task(file: SpeedFile, group: Group, out: Path, which: tuple[RecipeName, int, int]) -> Task:
    recipe, iterations, seed = which
    method = with_seed(name_of(file.method, iterations), seed)
    config, at = group.plan.config, SimpleNamespace(scene=group.scene, method=method)
    return Task(
        recipe,
        f"{method}/train",
        TrainJob.model_validate_json(stage_settings(config, "train", group.scene, method)),
        group.plan.code("train"),
        EvaluateJob.model_validate_json(stage_settings(config, "evaluate", group.scene, method)),
        DeviceSettings.model_validate_json(group.plan.device(at)),
        files_for(group, method),
        out / "trainings" / with_seed(f"{recipe}-{iterations}", seed),
        out / "images",
        file.workers,
    )
