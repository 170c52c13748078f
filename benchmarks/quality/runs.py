"""One run of Snakemake for a group of recipes, and what it says of what failed."""

import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from snakemake.cli import get_argument_parser

from benchmarks.quality.groups import Group
from drivesplat.errors import ConfigError
from drivesplat.io.storage import atomic_write
from drivesplat.workflow.job_logs import failures

CONFIG_FILE = "config.yaml"
"""What a group lays over the workflow's config.yaml: with it films and exports of its recipes can be had, too."""
OUTPUT_FILE = "snakemake.log"
DECIDED = {"configfile": "base", "config": "config", "targets": "recipes", "directory": "--out"}
"""What the recipes decide for Snakemake, and where."""
_JOB = re.compile(r"^(?:local)?(?:rule|checkpoint) \S+:$", re.MULTILINE)
"""How Snakemake announces a job."""


@dataclass(frozen=True)
class Outcome:
    """How a run of Snakemake ended: its exit `status`, why it started no job (None where it did, or had none to
    start), and the stages that failed, with their reasons."""

    status: int
    refusal: str | None
    failures: dict[str, str]

    def why(self, method: str) -> str | None:
        """Why a method has no result: what failed of its own, else of its scene; None where nothing is known to."""
        own = {stage: why for stage, why in self.failures.items() if stage.startswith(f"{method}/")}
        of_scene = {stage: why for stage, why in self.failures.items() if "/" not in stage}
        for stage, why in (own or of_scene).items():
            return f"{stage.rpartition('/')[2]}: {why}"
        return self.refusal


def passed_on(arguments: Sequence[str]) -> bool:
    """Whether Snakemake, called with these further arguments, is to run anything: not where it only plans.

    Raises ConfigError where they name what the recipes decide.
    """
    known, _ = get_argument_parser().parse_known_args(list(arguments))
    for name, instead in DECIDED.items():
        if getattr(known, name):
            raise ConfigError(f"Snakemake's {name} follows from the recipes: say it with {instead}")
    return not known.dryrun


def run(group: Group, arguments: Sequence[str], workflow: Path, targets: Iterable[str | Path] | None = None) -> Outcome:
    """Runs Snakemake in the folder `workflow` until every result of a group, or each of the files `targets`, is there
    or cannot be; what is measured stays. Its output goes to the console and into the group's folder."""
    settings = group.folder / CONFIG_FILE
    with atomic_write(settings) as file:
        file.write(yaml.safe_dump(group.overlay, sort_keys=False).encode())
    command = [
        *(sys.executable, "-m", "snakemake", "--configfile", str(settings), "--keep-going", "--show-failed-logs"),
        *(*arguments, "--", *map(str, group.targets if targets is None else targets)),
    ]
    with (
        open(group.folder / OUTPUT_FILE, "w", encoding="utf-8") as output,
        subprocess.Popen(
            command, cwd=workflow, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        ) as process,
    ):
        try:
            for line in process.stdout or ():
                print(line, end="", flush=True)
                output.write(line)
        except KeyboardInterrupt:
            process.communicate()  # it has been interrupted, too, and ends its jobs
            raise
    return outcome(process.returncode, (group.folder / OUTPUT_FILE).read_text(encoding="utf-8"))


def outcome(status: int, output: str) -> Outcome:
    """How a run ended, from its exit status and its output."""
    refused = status != 0 and not _JOB.search(output)
    return Outcome(status, _last_word(output) if refused else None, failures(output))


def _last_word(output: str) -> str:
    """What a run that started nothing said in the end: the workflow's own sentence, where there is one."""
    lines = [line for line in output.splitlines() if line.strip()] or ["nothing was said"]
    own = [line.removeprefix("drivesplat: ") for line in lines if line.startswith("drivesplat: ")]
    return (own or lines)[-1].strip()


def unexplained(group: Group, recipe: str, seed: int) -> str:
    """What to say of a result that is missing for no reason that a log tells: its job was killed, or never came."""
    return f"no result, and no reason given; see {group.folder / OUTPUT_FILE} and {group.log(recipe, seed, 'train')}"
