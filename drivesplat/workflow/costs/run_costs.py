"""What Snakemake's main process prints of a run: settings without effect at planning, an estimate at its start, its
progress, and costs.csv at its end."""

import os
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import leaves
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.costs.estimate import (
    Estimate,
    Expectations,
    Machine,
    PlannedJob,
    estimate,
    in_full,
    in_one_line,
)
from drivesplat.workflow.costs.measured import BENCHMARKS, JobId, read_costs
from drivesplat.workflow.costs.progress import RunProgress, watch
from drivesplat.workflow.costs.table import FILES, costs_in_words, finding, write_costs
from drivesplat.workflow.job_logs import has_failed
from drivesplat.workflow.long_drives import targets_without_drives
from drivesplat.workflow.named_tracks import edits_left_out
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.snakemake_log import drop_foreign_records
from drivesplat.workflow.without_cameras import methods_left_out
from drivesplat.workflow.without_tracks import methods_of, methods_without_boxes

CUT = "blocks"
"""The stage that makes the blocks of a drive known."""
COSTS, ESTIMATE = "costs", "estimate"
"""Targets that run no job: the first updates and prints costs.csv, the second prints the estimate."""


class RunCosts:
    """The costs of a run of Snakemake's `workflow` for `targets`."""

    def __init__(self, plan: Plan, workflow: Any, targets: Sequence[str]):
        self._plan, self._workflow, self._targets = plan, workflow, targets
        self._results = Path(plan.config.results_dir)
        self._jobs: dict[JobId, Any] = {}
        self._logs: dict[JobId, Path] = {}
        self._began = time.time()
        self._ended: threading.Event | None = None

    def report_at_planning(self) -> None:
        """Prints each setting that an override replaces for the scenes and methods of the targets, the methods of
        scenes without boxes, those that scenes without cameras leave out, edits whose tracks no method has, and targets
        that make nothing of a drive that is cut into blocks. `snakemake -n` and a run with nothing to do print them,
        too. Removes records on which Snakemake would fail, and prints which."""
        wanted = [target for target in self._targets if target not in (COSTS, ESTIMATE)]
        if wanted or COSTS not in self._targets:
            places = self._plan.scenes_and_methods(wanted)
            scenes = {scene for scene, _ in places}
            config = self._plan.config
            absent = [*methods_left_out(config, scenes), *edits_left_out(config, scenes)]
            unboxed = methods_without_boxes(config, scenes - {""}, places)
            cut = targets_without_drives(self._plan, wanted)
            for sentence in (*without_effect(config, places), *unboxed, *absent, *cut):
                _say(sentence)
        sentence = drop_foreign_records()
        if sentence:
            _say(sentence)

    def print_estimate(self) -> bool:
        """Prints the estimate in full if ESTIMATE is a target. Returns whether it is."""
        if ESTIMATE not in self._targets:
            return False
        self._plan_jobs()
        print(in_full(self.estimate()), flush=True)
        for sentence in self._unknown_blocks():
            print(f"drivesplat: {sentence}", flush=True)
        return True

    def begin(self) -> None:
        """Prints the estimate in a line and, from then on, the progress. A failure is printed and the run goes on."""
        try:
            self._plan_jobs()
            if self._jobs:
                _say(in_one_line(self.estimate()))
                for sentence in self._unknown_blocks():
                    _say(sentence)
                dag, jobs = self._workflow.dag, self._jobs
                watched = RunProgress(
                    self._planned_by_now,
                    self._logs,
                    self._expectations,
                    lambda: {name for name, job in jobs.items() if dag.finished(job)},
                    self._machine,
                    self._began,
                )
                self._ended = watch(watched)
        except Exception as error:  # a failed estimate must not end the run
            _say(f"the run cannot be estimated ({type(error).__name__}: {error})")

    def estimate(self) -> Estimate:
        """The estimate of the run."""
        return estimate(self._planned, self._expectations(), self._machine, self._results)

    def end(self) -> None:
        """Writes costs.csv and costs.json, and prints which scenes of this run took 90 minutes or more. A failure is
        printed and does not end the run."""
        if self._ended is not None:
            self._ended.set()
        try:
            config = self._plan.config
            ran = [scene for scene in config.scenes if (self._results / BENCHMARKS / scene).is_dir()]
            of_scenes = {scene: list(methods_of(config, scene)) for scene in ran}
            cut = [scene for scene in ran if config.is_cut(scene)]
            record = write_costs(self._results, list(config.methods), of_scenes, cut)
        except (DriveSplatError, OSError) as error:
            _say(f"costs are not written: {error}")
            return
        if COSTS in self._targets:
            print(costs_in_words(record), flush=True)
            return
        here = {job.scene for job in self._jobs}
        for total in record["scenes"]:
            if total["scene"] in here and not total["under_90_minutes"]:
                _say(f"scene {total['scene']}: {finding(total)}; {self._results / FILES[0]} says where it went")

    def name_failed_blocks(self) -> None:
        """Prints which blocks of drives failed in this run, or were interrupted, with logs and where to read on. A job
        that a cluster cancels before it begins has no log."""
        is_block, scheduler = self._plan.config.is_block, self._workflow.scheduler
        self._plan_jobs()
        ended = set() if scheduler is None else scheduler.failed
        of_blocks = [(name, log) for name, log in self._logs.items() if is_block(name.scene)]
        failed = {
            name.scene: log if log.is_file() else f"{name.stage} did not begin to write {log}"
            for name, log in reversed(of_blocks)
            if has_failed(log, self._began) or self._jobs[name] in ended
        }
        if failed:
            named = ", ".join(f"{scene} ({where})" for scene, where in failed.items())
            _say(
                f"these blocks failed or were interrupted: {named}; run again, or go on without them as "
                "docs/long_drives.md says"
            )

    def _plan_jobs(self) -> None:
        """Takes note of Snakemake's jobs that are to run, without those that only collect the results of others: more
        than before where blocks of a drive have become known."""
        folder = self._results / BENCHMARKS
        for job in [job for job in self._workflow.dag.needrun_jobs() if job.benchmark]:
            name = JobId.of(Path(os.path.relpath(job.benchmark, folder)))
            self._jobs[name] = job
            if job.log:
                self._logs[name] = Path(str(job.log[0]))

    def _unknown_blocks(self) -> list[str]:
        """A sentence for each drive whose blocks are known only when this run has cut it."""
        cut = sorted(job.scene for job in self._jobs if job.stage == CUT)
        return [
            f"the blocks of scene {scene} are not known yet, and their jobs are not in the estimate: make "
            f"{self._results}/{scene}/blocks.json first, or use drivesplat estimate (docs/costs.md)"
            for scene in cut
        ]

    def _planned_by_now(self) -> list[PlannedJob]:
        """The planned jobs, in a thread beside Snakemake's own, which may add jobs meanwhile."""
        with suppress(RuntimeError):  # the set changed while it was read: the next line has them
            self._plan_jobs()
        return self._planned

    @property
    def _planned(self) -> list[PlannedJob]:
        return [planned_job(name, job) for name, job in self._jobs.items()]

    @property
    def _machine(self) -> Machine:
        """The cores and GPUs of the run; on a cluster, which counts no cores, those of its concurrent jobs."""
        resources = self._workflow.global_resources
        cores, nodes, gpus = (resources[n].value if n in resources else None for n in ("_cores", "_nodes", "gpu"))
        widest = max((one.threads for one in self._planned), default=1)
        return Machine(cores or (nodes or 1) * widest, gpus if isinstance(gpus, int) and gpus > 0 else 1)

    def _expectations(self) -> Expectations:
        return Expectations(self._plan.config, read_costs(self._results)[0])


def planned_job(name: JobId, job: Any) -> PlannedJob:
    """One of Snakemake's jobs. It takes a GPU if its rule requests one, which rules on the CPU do not."""
    return PlannedJob(name, int(job.threads), bool(job.resources.get("gpu")), tuple(map(str, job.output)))


def _say(line: str) -> None:
    print(f"drivesplat: {line}", file=sys.stderr, flush=True)


def without_effect(config: Config, places: Iterable[tuple[str, str]]) -> list[str]:
    """One sentence for every setting that is not at its default and that an override replaces in one of `places`: pairs
    of a scene and a method, or of a scene and an empty name. Overrides of ablation variants are not reported."""
    given, defaults = leaves(config.model_dump()), leaves(Config().model_dump())
    changed = {key: value for key, value in given.items() if defaults.get(key) != value}
    if not changed:
        return []
    sentences: dict[str, None] = {}
    scenes = {(config.dataset_of(scene), method): scene for scene, method in places if scene in config.dataset_names}
    for (dataset, method), scene in sorted(scenes.items()):
        below = given
        layers = [("dataset", dataset, for_scene(config, scene))]
        if method in {**methods_of(config, scene), **config.methods}:
            layers.append(("method", method, for_scene(config, scene, method)))
        for kind, name, there in layers:
            used = leaves(there.model_dump())
            for key, value in changed.items():
                if used.get(key, value) not in (value, below.get(key)):
                    where = f"{kind}s.{name}.overrides.{key}"
                    sentences[f"{key}: {value} does not hold for {kind} {name}, where {where} is {used[key]}"] = None
            below = used
    return list(sentences)
