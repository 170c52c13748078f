"""Progress and remaining time of a run: a line every half minute, beside Snakemake's count of jobs."""

import re
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivesplat.workflow.costs.estimate import (
    NOT_KNOWN,
    Expectations,
    Machine,
    PlannedJob,
    counted,
    spelled,
    wall_seconds,
)
from drivesplat.workflow.costs.measured import TRAIN, JobId
from drivesplat.workflow.job_logs import has_begun, is_cut_short

EVERY_S = 30.0
MAX_NAMED = 4
"""Running jobs that are named at most."""
_PROGRESS = re.compile(r"iteration (\d+) of (\d+), loss ([^\s,]+)(?:, \S+ it/s, (\d+) s left)?$", re.MULTILINE)
"""The progress that a training logs (`drivesplat.training.monitor`)."""


@dataclass
class RunProgress:
    """The progress of a run of `planned` jobs, which become more where blocks of a drive are known only in the run;
    their `logs` tell which are running and how far trainings are; `began` is the time of its begin.

    Expected seconds are updated with every line, since jobs that finish in this run are measured, too.
    """

    planned: Callable[[], Sequence[PlannedJob]]
    logs: Mapping[JobId, Path]
    expectations: Callable[[], Expectations]
    finished: Callable[[], set[JobId]]
    machine: Machine
    began: float
    _since: dict[JobId, float] = field(default_factory=dict)

    def line(self, now: float) -> str:
        """'37 % of the work, 12 of 40 jobs, about 9 min left; at work: 0103 street masks'; without a share of the work
        while the costs of some jobs are unknown, and without a time before any is known. A training is named with its
        iteration, loss and remaining time."""
        planned, expectations, finished = self.planned(), self.expectations(), self.finished()
        done, unknown, left, at_work = 0.0, 0, [], []
        for one in planned:
            seconds, _ = expectations.of(one.job)
            working = False if one.job in finished else self._is_at_work(one.job)
            remaining = seconds if working is None else 0.0
            if working:
                part, remaining, described = self._of_running(one.job, seconds, now)
                at_work.append(f"{one.job.name}{described}")
                if part is not None and remaining is not None:
                    seconds = remaining / (1.0 - min(part, 0.99))
            if remaining is None:
                unknown += 1
                continue
            done += max(0.0, (seconds or 0.0) - remaining)
            left.append(replace(one, seconds=remaining))
        whole = done + sum(one.seconds for one in left)
        share = "" if unknown else f"{100.0 * done / whole if whole else 100.0:.0f} % of the work, "
        time_left = spelled(wall_seconds(left, self.machine))
        more = f" and {len(at_work) - MAX_NAMED} more" if len(at_work) > MAX_NAMED else ""
        named = f"; at work: {', '.join(at_work[:MAX_NAMED])}{more}" if at_work else ""
        jobs = f"{share}{len(finished)} of {len(planned)} jobs"
        if not unknown:
            return f"{jobs}, about {time_left} left{named}"
        if whole <= done:
            return f"{jobs} done{named}"
        return f"{jobs}, about {time_left} left without {counted(unknown)} whose time is {NOT_KNOWN}{named}"

    def _is_at_work(self, job: JobId) -> bool | None:
        """Whether a job is running, by its log of this run, since Snakemake counts a finished job seconds later; None
        before it begins."""
        log = self.logs.get(job)
        try:
            text = log.read_text("utf-8") if log and log.stat().st_mtime >= self.began else ""
        except (OSError, UnicodeDecodeError):
            return None
        return is_cut_short(text) if has_begun(text) else None

    def _of_running(self, job: JobId, expected: float | None, now: float) -> tuple[float | None, float | None, str]:
        """The fraction of a running job that is done where its log tells it, the seconds it still needs where known,
        and both in words."""
        elapsed = now - self._since.setdefault(job, now)
        left = None if expected is None else max(0.0, expected - elapsed)
        logged = _PROGRESS.findall(self.logs[job].read_text("utf-8")) if job.stage == TRAIN else []
        if not logged:
            return None, left, ""
        step, iterations, loss, seconds = logged[-1]
        if not seconds:
            return None, left, f" (iteration {step} of {iterations}, loss {loss})"
        described = f" (iteration {step} of {iterations}, loss {loss}, {spelled(float(seconds))} left)"
        return int(step) / int(iterations), float(seconds), described


def watch(progress: RunProgress, every_s: float = EVERY_S) -> threading.Event:
    """Starts a thread that prints a run's progress every `every_s` seconds until the returned event is set, or the
    process ends."""
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(every_s):
            try:
                line = progress.line(time.time())
            except Exception as error:  # a failure to report progress must not end the run
                line = f"the progress of the run is unknown ({type(error).__name__}: {error})"
            print(f"drivesplat: {line}", file=sys.stderr, flush=True)

    threading.Thread(target=look, name="progress", daemon=True).start()
    return ended
