"""The expected time and disk of a run before it starts, from what has been measured in its results folder."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesplat.workflow.costs.disk import DiskNeed, disk_need
from drivesplat.workflow.costs.expected import Expectations, Work, wall_seconds
from drivesplat.workflow.costs.measured import JobId

NOT_MEASURED = "not measured yet"


@dataclass(frozen=True)
class Machine:
    """What jobs are spread over."""

    cores: int
    gpus: int


@dataclass(frozen=True)
class PlannedJob:
    """A job that is to run, the threads it takes, whether it takes a GPU, and its declared outputs."""

    job: JobId
    threads: int
    on_gpu: bool
    outputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """The expected wall time (s) of those of a run's `jobs` that are `known` from `measured` jobs; per stage the number
    of jobs and the mean seconds of the known ones (None: not measured), the dearest first; and the disk they fill."""

    jobs: int
    seconds: float
    known: int
    measured: int
    by_stage: dict[str, tuple[int, float | None]]
    machine: Machine
    disk: DiskNeed


def estimate(planned: Sequence[PlannedJob], expectations: Expectations, machine: Machine, results: Path) -> Estimate:
    """The estimate of `planned` jobs in a results folder."""
    expected = [expectations.of(one.job) for one in planned]
    work = [
        Work(one.job, found.seconds, one.threads, one.on_gpu)
        for one, found in zip(planned, expected, strict=True)
        if found.seconds is not None
    ]
    stages: dict[str, list[float]] = {one.job.stage: [] for one in planned}
    for known in work:
        stages[known.job.stage].append(known.seconds)
    jobs = [one.job.stage for one in planned]
    dearest = sorted(stages, key=lambda stage: -sum(stages[stage]))
    return Estimate(
        jobs=len(planned),
        seconds=wall_seconds(work, machine.cores, machine.gpus),
        known=len(work),
        measured=len(frozenset().union(*(found.measured for found in expected))),
        by_stage={s: (jobs.count(s), sum(stages[s]) / len(stages[s]) if stages[s] else None) for s in dearest},
        machine=machine,
        disk=disk_need(results, [(one.job, one.outputs) for one in planned], expectations.peers),
    )


def in_one_line(found: Estimate) -> str:
    """'27 jobs, about 12 min on 4 cores (from 22 measured jobs; 3 not measured yet), about 0.4 GB of disk (…)'."""
    if not found.jobs:
        return "nothing is to be run"
    jobs = f"{found.jobs} job{'s' * (found.jobs > 1)}"
    return f"{jobs}, {_time(found)}, {_disk(found)}"


def _time(found: Estimate) -> str:
    if not found.known:
        return f"time {NOT_MEASURED}"
    cores, gpus = found.machine.cores, found.machine.gpus
    where = f"{cores} core{'s' * (cores > 1)}" + (f" and {gpus} GPUs" if gpus > 1 else "")
    rest = found.jobs - found.known
    missing = f"; {rest} {NOT_MEASURED}" if rest else ""
    basis = f"from {found.measured} measured job{'s' * (found.measured > 1)}{missing}"
    return f"about {spelled(found.seconds)} on {where} ({basis})"


def _disk(found: Estimate) -> str:
    disk, free = found.disk, f"{found.disk.free / 1e9:.1f} GB free"
    if disk.unknown == found.jobs:
        return f"disk {NOT_MEASURED} ({free})"
    missing = f"; {disk.unknown} jobs {NOT_MEASURED}" if disk.unknown else ""
    warning = "; that is more than there is" if disk.needed > disk.free else ""
    return f"about {_spelled_bytes(disk.needed)} of disk ({free}{missing}){warning}"


def in_full(found: Estimate) -> str:
    """The line, and a table of stages."""
    lines = [f"drivesplat: {in_one_line(found)}"]
    for stage, (jobs, seconds) in found.by_stage.items():
        lines.append(f"  {stage:<16}{jobs:>5} x {NOT_MEASURED if seconds is None else f'{seconds:>8.1f} s'}")
    return "\n".join(lines)


def spelled(seconds: float) -> str:
    """'45 s', '12 min', '3 h 5 min'."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _spelled_bytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
