"""Methods trained on one scene with several random seeds, in one results folder, by one call of Snakemake."""

import re
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import yaml
from snakemake.cli import get_argument_parser

from benchmarks.files import BenchmarkFile, error_prefix
from drivesplat.errors import ConfigError
from drivesplat.io.storage import atomic_write
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings.config import DATASET_OVERRIDES, load
from drivesplat.settings.method import MethodSettings, merged, with_seed, with_seeds
from drivesplat.workflow.plan import Plan

CONFIG_FILE = "config.yaml"
"""The overlay of a run in its results folder. With it the user can request films and exports of its methods."""
RESERVED = {"configfile": "base", "config": "config", "targets": "the file's content", "directory": "--out"}
"""Snakemake's arguments that a benchmark sets itself, and where the user sets them instead."""
_JOB = re.compile(r"(?:local)?(?:rule|checkpoint) \S+:$")
"""How Snakemake announces a job."""


@dataclass(frozen=True)
class ConfigLayers:
    """The content of config.yaml (`default`), and an `overlay` of settings over it."""

    default: Mapping[str, Any]
    overlay: Mapping[str, Any]

    @classmethod
    def of(cls, file: BenchmarkFile, workflow: Path) -> "ConfigLayers":
        """config.yaml of the folder `workflow` under the config files and settings of a benchmark file. Paths are
        relative to the current folder. Raises ConfigError if the settings are invalid."""
        overlay = reduce(merged, (_config_file(Path(path).expanduser()) for path in file.base), {})
        with error_prefix("base and config"):
            layers = cls(_config_file(workflow / "config.yaml"), overlay).with_scene_settings(file.config, file.scene)
            load(layers.values)
        return layers

    @property
    def values(self) -> dict[str, Any]:
        """Both layers merged."""
        return merged(self.default, self.overlay)

    def with_settings(self, tree: Mapping[str, Any]) -> "ConfigLayers":
        """These layers with a further tree in the overlay."""
        return ConfigLayers(self.default, merged(self.overlay, tree))

    def with_scene_settings(self, tree: Mapping[str, Any], scene: str) -> "ConfigLayers":
        """The same, with the tree also over the overrides of the scene's dataset."""
        own = {key: value for key, value in tree.items() if key in DATASET_OVERRIDES}
        layers = self.with_settings({key: value for key, value in tree.items() if key not in own})
        dataset = load(layers.values).dataset_of(scene)
        return layers.with_settings({"datasets": {dataset: {"overrides": own}}}) if own else layers


@dataclass(frozen=True)
class Outcome:
    """A call of Snakemake that has ended: its exit status, why it failed before its first job (None if it did not), and
    when it was started (seconds since the epoch)."""

    status: int
    refusal: str | None = None
    start: float = 0.0


@dataclass(frozen=True)
class SnakemakeRun:
    """`methods` (names without seed), each with every seed, on one scene: the plan of the config that holds for them,
    and `overlay`, the part of it that is laid over config.yaml."""

    scene: str
    seeds: tuple[int, ...]
    methods: tuple[str, ...]
    plan: Plan
    overlay: dict[str, Any]

    @classmethod
    def of(
        cls,
        layers: ConfigLayers,
        file: BenchmarkFile,
        methods: Mapping[str, MethodSettings],
        folder: Path,
        workflow: Path,
    ) -> "SnakemakeRun":
        """The run of `methods`, in place of those of the config, with results in `folder`."""
        seeded = {name: m.model_dump(mode="json") for name, m in with_seeds(methods, file.seeds).items()}
        dropped = dict.fromkeys(load(layers.values).methods)
        layers = layers.with_settings({"methods": dropped | seeded, "results_dir": str(folder)})
        return cls(file.scene, file.seeds, tuple(methods), Plan(layers.values, str(workflow)), dict(layers.overlay))

    @property
    def folder(self) -> Path:
        """The results folder."""
        return Path(self.plan.config.results_dir)

    @property
    def logs(self) -> Path:
        return self.folder / "logs"

    @property
    def targets(self) -> list[Path]:
        """The eval.json of every method with every seed."""
        return [self.evaluation(method, seed) for method in self.methods for seed in self.seeds]

    def evaluation(self, method: str, seed: int) -> Path:
        """The eval.json of a method with a seed."""
        return self.folder / self.scene / with_seed(method, seed) / "eval.json"

    def log(self, method: str, seed: int, stage: str) -> Path:
        """The log of a stage of a method with a seed."""
        return self.logs / self.scene / with_seed(method, seed) / f"{stage}.log"

    def start(self, arguments: Sequence[str], workflow: Path, targets: Iterable[str | Path] | None = None) -> Outcome:
        """Runs Snakemake in the folder `workflow` for `targets` (None: every eval.json); finished results stay."""
        start = time.time()
        settings = self.folder / CONFIG_FILE
        with atomic_write(settings) as file:
            file.write(yaml.safe_dump(self.overlay, sort_keys=False).encode())
        command = [
            *(sys.executable, "-m", "snakemake", "--configfile", str(settings), "--keep-going", "--show-failed-logs"),
            *(*arguments, "--", *map(str, self.targets if targets is None else targets)),
        ]
        lines, piped = [], {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "errors": "replace"}
        with subprocess.Popen(command, cwd=workflow, **piped) as process:
            try:
                for line in process.stdout or ():
                    print(line, end="", flush=True)
                    lines.append(line)
            except KeyboardInterrupt:
                process.communicate()  # Snakemake was interrupted as well: wait until it has ended its jobs
                raise
        return Outcome(process.returncode, refusal(lines) if process.returncode else None, start)


def refusal(lines: Sequence[str]) -> str | None:
    """Why Snakemake, with this output, failed before its first job: the workflow's own message, else the last line.
    None if it has started a job."""
    if any(_JOB.match(line) for line in lines):
        return None
    said = [line.strip() for line in lines if line.strip()] or ["Snakemake ended without a message"]
    own = [line.removeprefix("drivesplat: ") for line in said if line.startswith("drivesplat: ")]
    return (own or said)[-1]


def is_dry_run(arguments: Sequence[str]) -> bool:
    """Whether Snakemake only plans with these arguments. Raises ConfigError if they hold one of RESERVED."""
    known, _ = get_argument_parser().parse_known_args(list(arguments))
    for name, instead in RESERVED.items():
        if getattr(known, name):
            raise ConfigError(f"Snakemake's {name} is set by the benchmark file: use {instead}")
    return known.dryrun


def _config_file(path: Path) -> dict[str, Any]:
    content = read_yaml(path, "config file")
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path}: a config file holds settings by their names, as config.yaml does")
    return content or {}
