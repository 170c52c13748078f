"""What a run is expected to take, in time and on disk, before it starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from drivesplat.workflow.costs.disk import DiskNeed, Leaves, disk_need
from drivesplat.workflow.costs.expected import KNOWN_MACHINE, Expectations, Work, wall_seconds
from drivesplat.workflow.costs.measured import Job
from drivesplat.workflow.costs.usual import usual_bytes


@dataclass(frozen=True)
class Machine:
    """What jobs are spread over."""

    cores: int
    gpus: int


@dataclass(frozen=True)
class PlannedJob:
    """A job that is to run, the threads it takes, whether it takes a GPU, and the files that it makes."""

    job: Job
    threads: int
    on_gpu: bool
    outputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """The seconds that `jobs` take on a machine, by the clock on the wall; how many of them are `known`, and from how
    many jobs that were `measured`; jobs and seconds of work by stage, the dearest first; and the disk they fill."""

    jobs: int
    seconds: float
    known: int
    measured: int
    by_stage: dict[str, tuple[int, float]]
    machine: Machine
    disk: DiskNeed


def estimate(planned: Sequence[PlannedJob], expectations: Expectations, machine: Machine, results: Path) -> Estimate:
    """What is to be expected of `planned` jobs in a folder of results."""
    expected = [expectations.of(one.job) for one in planned]
    work = [Work(one.job, found.seconds, one.threads, one.on_gpu) for one, found in zip(planned, expected, strict=True)]
    stages: dict[str, tuple[int, float]] = {}
    for one in work:
        jobs, seconds = stages.get(one.job.stage, (0, 0.0))
        stages[one.job.stage] = jobs + 1, seconds + one.seconds
    return Estimate(
        jobs=len(work),
        seconds=wall_seconds(work, machine.cores, machine.gpus),
        known=sum(bool(found.measured) for found in expected),
        measured=len(frozenset().union(*(found.measured for found in expected))),
        by_stage=dict(sorted(stages.items(), key=lambda item: -item[1][1])),
        machine=machine,
        disk=disk_need(
            results,
            [Leaves(one.job, one.outputs) for one in planned],
            expectations.peers,
            partial(usual_bytes, expectations.config),
        ),
    )


def in_one_line(found: Estimate) -> str:
    """'27 jobs, about 12 min on 4 cores and 1 GPU (…), about 0.4 GB of disk (70.0 GB free)'."""
    if not found.jobs:
        return "nothing is to be run"
    cores, gpus = found.machine.cores, found.machine.gpus
    where = f"{cores} core{'s' * (cores > 1)}" + (f" and {gpus} GPUs" if gpus > 1 else "")
    disk = f"about {_spelled_bytes(found.disk.needed)} of disk ({found.disk.free / 1e9:.1f} GB free)"
    warning = "; that is more than there is" if found.disk.needed > found.disk.free else ""
    jobs = f"{found.jobs} job{'s' * (found.jobs > 1)}"
    return f"{jobs}, about {spelled(found.seconds)} on {where} ({_basis(found)}), {disk}{warning}"


def _basis(found: Estimate) -> str:
    """How the time is known."""
    if not found.known:
        return "no such job measured here yet: rough"
    rest = found.jobs - found.known
    return f"from {found.measured} measured job{'s' * (found.measured > 1)}" + (f"; {rest} rough" if rest else "")


def in_full(found: Estimate) -> str:
    """The line, and a table of stages."""
    lines = [f"drivesplat: {in_one_line(found)}"]
    lines += [f"  {stage:<16}{jobs:>5} x {seconds / jobs:>8.1f} s" for stage, (jobs, seconds) in found.by_stage.items()]
    if found.known < found.jobs:
        lines.append(f"  rough: as on {KNOWN_MACHINE},")
        lines.append("         trainings by their iterations; on another machine it may be off by a factor of five")
    if found.disk.rough:
        lines.append(f"  disk: for {found.disk.rough} of the jobs what is usual, for want of other scenes' files")
    return "\n".join(lines)


def spelled(seconds: float) -> str:
    """'45 s', '12 min', '3 h 5 min'."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _spelled_bytes(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
