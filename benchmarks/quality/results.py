"""The results of recipes after Snakemake has ended: figures of the current settings, or why there are none."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.snakemake_run import Outcome, SnakemakeRun
from drivesplat.errors import ResultError
from drivesplat.io.storage import read_json, unreadable
from drivesplat.provenance.record import differences
from drivesplat.settings.method import with_seed
from drivesplat.workflow.job_logs import failures

GPU_STAGES = ("train", "evaluate")
PROCESSORS = "the processors"
_TIME = r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) "
TIME_FORMAT = "%Y-%m-%d %H:%M:%S,%f"
"""The time stamps of logs (`drivesplat.workflow.job`)."""
_LINE = re.compile(_TIME, re.MULTILINE)
_GPU = re.compile(_TIME + r"INFO drivesplat\.workflow\.gpus: runs on the GPU \S+ \((\S+)\)$", re.MULTILINE)


@dataclass(frozen=True)
class Result:
    """A recipe trained with a seed: the path and content of its eval.json, or `reason` why there is none; `shared` if
    another job ran on the same GPU, or the same processors, during its training."""

    recipe: str
    seed: int
    path: Path
    evaluation: dict[str, Any] | None = None
    reason: str = ""
    shared: bool = False

    @property
    def figures(self) -> dict[str, Any] | None:
        return self.evaluation["result"] if self.evaluation else None


@dataclass(frozen=True)
class DeviceUse:
    """The time during which a job held a GPU (by its identity) or the processors."""

    device: str
    start: datetime
    end: datetime

    def overlaps(self, other: "DeviceUse") -> bool:
        """Whether both held the same device at the same time."""
        return self.device == other.device and self.start < other.end and other.start < self.end


def collect_results(ended: Sequence[tuple[SnakemakeRun, Outcome]]) -> list[Result]:
    """The result of every recipe with every seed, of runs that have ended."""
    found = [
        (run, _result(run, recipe, seed, outcome))
        for run, outcome in ended
        for recipe in run.methods
        for seed in run.seeds
    ]
    uses = {
        (result.recipe, result.seed, stage): use
        for run, result in found
        for stage in GPU_STAGES
        if (use := _device_use(run, result, stage)) is not None
    }
    return [dataclasses.replace(result, shared=_is_shared(result, uses)) for _, result in found]


def _result(run: SnakemakeRun, recipe: str, seed: int, outcome: Outcome) -> Result:
    """The result of a recipe with a seed. An eval.json that was made otherwise than the run's plan says does not count:
    a failed training leaves the figures of an earlier one in place."""
    path, method = run.evaluation(recipe, seed), with_seed(recipe, seed)
    missing = Result(recipe, seed, path, reason=missing_reason(run, recipe, seed, outcome))
    if not path.is_file():
        return missing
    try:
        evaluation = read_json(path, rule="evaluate")
        stale = differences(run.plan.evaluation_stages(run.scene, [method]), evaluation["provenance"]["stages"])
    except ResultError as error:
        return dataclasses.replace(missing, reason=str(error))
    except (AttributeError, KeyError, TypeError) as error:
        reason = unreadable(path, "evaluate", f"not the figures of a method ({type(error).__name__}: {error})")
        return dataclasses.replace(missing, reason=str(reason))
    if stale:
        return dataclasses.replace(missing, reason=f"{missing.reason} (an earlier result does not count: {stale[0]})")
    return Result(recipe, seed, path, evaluation)


def missing_reason(run: SnakemakeRun, recipe: str, seed: int, outcome: Outcome) -> str:
    """Why a recipe with a seed has no result: a failure in a log of this run, of one of the method's own stages or of
    one that prepares the scene, else the refusal of the whole run."""
    folder = run.logs / run.scene
    own = (folder / with_seed(recipe, seed)).glob("*.log")
    for files in (own, folder.glob("*.log"), (run.logs / "demo_world").glob("*.log")):
        for file in files:
            if file.stat().st_mtime >= outcome.start:
                for stage, why in failures(file.read_text(encoding="utf-8", errors="replace")).items():
                    return f"{stage.rpartition('/')[2]}: {why}"
    return outcome.refusal or f"no result, and no reason given; see {run.log(recipe, seed, 'train')}"


def device_use(log: str, on_processors: bool) -> DeviceUse | None:
    """The device that a job held, by its log. A job whose log names no GPU may be known to have run `on_processors`;
    otherwise None."""
    times, gpu = [datetime.strptime(time, TIME_FORMAT) for time in _LINE.findall(log)], _GPU.search(log)
    if gpu:
        return DeviceUse(gpu[2], datetime.strptime(gpu[1], TIME_FORMAT), times[-1])
    return DeviceUse(PROCESSORS, times[0], times[-1]) if on_processors and times else None


def _device_use(run: SnakemakeRun, result: Result, stage: str) -> DeviceUse | None:
    try:
        log = run.log(result.recipe, result.seed, stage).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    return device_use(log, on_processors=result.figures is not None and result.figures["device"].startswith("cpu"))


def _is_shared(result: Result, uses: Mapping[tuple[str, int, str], DeviceUse]) -> bool:
    own = uses.get((result.recipe, result.seed, "train"))
    others = (use for key, use in uses.items() if key[:2] != (result.recipe, result.seed))
    return own is not None and any(own.overlaps(other) for other in others)
