"""How far a run is, and how long it goes on: a line now and then, while Snakemake counts jobs."""

import re
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from drivesplat.workflow.costs.estimate import Machine, PlannedJob, spelled
from drivesplat.workflow.costs.expected import Expectations, Work, wall_seconds
from drivesplat.workflow.costs.measured import TRAIN, Job
from drivesplat.workflow.job_logs import has_begun, is_cut_short

EVERY_S = 30.0
SHOWN = 4
"""Jobs at work that are named at most."""
TAIL_BYTES = 4096
_PROGRESS = re.compile(r"([\d.]+) %, [\d.]+ it/s, (\d+) s left")
"""How a training tells its log how far it is (`drivesplat.training.monitor`)."""


class Progress:
    """How far a run of `planned` jobs is, whose `logs` tell which are at work and how far trainings are.

    What is expected of the jobs that are left is asked anew every time: those of this run that are done tell.
    """

    def __init__(
        self,
        planned: Sequence[PlannedJob],
        logs: Mapping[Job, Path],
        expectations: Callable[[], Expectations],
        finished: Callable[[], set[Job]],
        machine: Machine,
        began: float,
    ):
        self._planned, self._logs, self._machine, self._began = planned, logs, machine, began
        self._expectations, self._finished = expectations, finished
        self._since: dict[Job, float] = {}

    def line(self, now: float) -> str:
        """'37 % of the work, 12 of 40 jobs, about 9 min left; at work: 0103 street train (43 %)'."""
        expectations, finished = self._expectations(), self._finished()
        done, left, at_work = 0.0, [], []
        for one in self._planned:
            seconds = expectations.of(one.job).seconds
            working = False if one.job in finished else self._is_at_work(one.job)
            remaining = seconds if working is None else 0.0
            if working:
                part, remaining = self._of_running(one.job, seconds, now)
                at_work.append(f"{one.job.name} ({part:.0f} %)" if part is not None else one.job.name)
                seconds = max(seconds, remaining) if part is None else remaining / (1.0 - min(part, 99.0) / 100.0)
            done += seconds - remaining
            left.append(Work(one.job, remaining, one.threads, one.on_gpu))
        whole = done + sum(work.seconds for work in left)
        share = 100.0 * done / whole if whole else 100.0
        more = f" and {len(at_work) - SHOWN} more" if len(at_work) > SHOWN else ""
        named = f"; at work: {', '.join(at_work[:SHOWN])}{more}" if at_work else ""
        time_left = spelled(wall_seconds(left, self._machine.cores, self._machine.gpus))
        return f"{share:.0f} % of the work, {len(finished)} of {len(self._planned)} jobs, about {time_left} left{named}"

    def _is_at_work(self, job: Job) -> bool | None:
        """Whether a job is at work, as its log of this run says, and not over, though Snakemake may take seconds to
        count it; None where it has not begun."""
        log = self._logs.get(job)
        try:
            text = log.read_text("utf-8") if log and log.stat().st_mtime >= self._began else ""
        except (OSError, UnicodeDecodeError):
            return None
        return is_cut_short(text) if has_begun(text) else None

    def _of_running(self, job: Job, expected: float, now: float) -> tuple[float | None, float]:
        """How far a job at work is, in percent, where it says so, and the seconds it still needs."""
        elapsed = now - self._since.setdefault(job, now)
        told = _PROGRESS.findall(_tail(self._logs[job])) if job.stage == TRAIN else []
        if told:
            return float(told[-1][0]), float(told[-1][1])
        return None, max(0.0, expected - elapsed)


def _tail(path: Path) -> str:
    with open(path, "rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - TAIL_BYTES))
        return file.read().decode(errors="replace")


class Watch:
    """A thread that prints a run's progress every EVERY_S seconds until it is told to stop, or the process ends."""

    def __init__(self, progress: Progress, every_s: float = EVERY_S):
        self._progress, self._every_s = progress, every_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, name="progress", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()

    def _look(self) -> None:
        while not self._ended.wait(self._every_s):
            try:
                line = self._progress.line(time.time())
            except Exception as error:  # a run must not end for what is told of it
                line = f"how far the run is cannot be told ({type(error).__name__}: {error})"
            print(f"drivesplat: {line}", file=sys.stderr, flush=True)
