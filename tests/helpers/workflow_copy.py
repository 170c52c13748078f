"""A copy of the workflow in a folder of its own, run as users run it: as a subprocess, with a config file."""

import compileall
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml

from helpers import REPOSITORY
from helpers.drives import World, write_world
from helpers.forked_snakemake import run_snakemake

PARTS = (
    "Snakefile", "benchmarks", "config.yaml", "config.schema.json", "docs", "drivesplat", "envs", "presets", "profiles",
    "report", "rules", "workflow_scripts",
)  # fmt: skip
TINY_TRAINING = {
    "iterations": 60, "log_every": 10, "checkpoint_every": 20, "min_checkpoint_interval_s": 0.0, "image_every": 30,
    "gaussians": {"sh_degree": 1}, "sky_resolution": 8,
}  # fmt: skip
_COSTS = re.compile(
    r"drivesplat: (\d+ jobs?, |(\d+ % of the work, )?\d+ of \d+ jobs, |report of finished |PSNR of held-out images |"
    r"results of this run)"
)


def complaints(output: str) -> set[str]:
    """The workflow's own lines in a run's output, but for those that say what it costs, how far it is, and where its
    figures and pages are."""
    return {line for line in output.splitlines() if line.startswith("drivesplat: ") and not _COSTS.match(line)}


@dataclass
class WorkflowCopy:
    """The workflow at `folder`, with `config` in its mine.yaml."""

    folder: Path
    config: dict[str, Any]

    @classmethod
    def make(cls, folder: Path, world: World | None = None, **config: Any) -> "WorkflowCopy":
        """Copies the workflow and writes a tiny world beside it; `config` is laid over the tests' settings. The methods
        that it names are all there are."""
        folder.mkdir(parents=True, exist_ok=True)
        _compiled()
        for part in PARTS:
            source, ignore = REPOSITORY / part, shutil.ignore_patterns("kernels-*", "*.opt-jaxtyping*.pyc")
            copy_part = partial(shutil.copytree, ignore=ignore) if source.is_dir() else shutil.copy2
            copy_part(source, folder / part)
        if "methods" in config:
            _drop(folder / "config.yaml", "methods")  # what is laid over that file can only add to them
        world = world or World()
        write_world(folder / "data", world)
        base = {
            "datasets": {"nuscenes": {"dataroot": "data", "scenes": list(world.scenes)}},
            "refine_poses": {"enabled": False},
            "lidar_seed": {"max_points": 500, "far_points": 100},
            "train": TINY_TRAINING,
            # of a drive of 4.5 s the usual last block leaves little
            "render": {"width": 64, "height": 36, "fps": 4, "end": "recorded"},
            "lpips": {"enabled": False},
            "device": "cpu",
        }
        copy = cls(folder, {**base, **config})
        copy.write_config()
        return copy

    def again(self, folder: Path) -> "WorkflowCopy":
        """Another copy, with all that this one has made by now."""
        return WorkflowCopy(Path(shutil.copytree(self.folder, folder, symlinks=True)), deepcopy(self.config))

    def write_config(self, text: str | None = None) -> None:
        (self.folder / "mine.yaml").write_text(text or yaml.safe_dump(self.config, sort_keys=False))

    @contextmanager
    def set_to(self, **config: Any) -> Iterator[None]:
        """Other values of the config for a while."""
        before, self.config = self.config, {**self.config, **config}
        self.write_config()
        try:
            yield
        finally:
            self.config = before
            self.write_config()

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "snakemake", *self._arguments(*arguments)]

    def _arguments(self, *arguments: str) -> list[str]:
        """Snakemake's arguments."""
        return ["--configfile", "mine.yaml", *arguments]

    def run(
        self, *targets: str, cores: int = 2, flags: tuple[str, ...] = (), gpus: str = "", under: tuple[str, ...] = (),
        timeout: float = 600,
    ) -> subprocess.CompletedProcess:  # fmt: skip
        """Runs Snakemake for `timeout` seconds at most, on a machine that seems to have these `gpus`, by the program
        `under` where one is given; the result holds its output (both streams) as `stdout`."""
        arguments = ("--cores", str(cores), *flags, "--", *targets)
        environment = {**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": gpus}
        if not under:
            return run_snakemake(self._arguments(*arguments), self.folder, environment, timeout)
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        command = [*under, *self.command(*arguments)]
        return subprocess.run(command, cwd=self.folder, env=environment, timeout=timeout, **streams)

    def dry_run(self, *targets: str) -> str:
        """What `snakemake -n` prints; raises where planning fails."""
        done = self.run(*targets, flags=("-n",))
        if done.returncode:
            raise AssertionError(done.stdout)
        return done.stdout

    def planned(self, *targets: str) -> dict[str, int]:
        """How many jobs of each rule `snakemake -n` plans; raises where planning fails."""
        table = self.dry_run(*targets).rpartition("Job stats:")[2].partition("total")[0]
        return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", table, re.M) if name != "all"}

    def read(self, path: str) -> Any:
        return json.loads((self.folder / path).read_text())


@cache
def _compiled() -> None:
    """Compiles the library once, for every copy: what is compiled goes along, and is valid where its source is as old.
    Otherwise each copy's first call, and its first job, would compile a hundred modules of their own."""
    if not sys.dont_write_bytecode:
        compileall.compile_dir(REPOSITORY / "drivesplat", quiet=2)


def _drop(config: Path, key: str) -> None:
    """Takes a key out of a YAML file."""
    content = yaml.safe_load(config.read_text())
    del content[key]
    config.write_text(yaml.safe_dump(content, sort_keys=False))
