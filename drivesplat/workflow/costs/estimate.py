"""The expected time and disk of a run, from what the same jobs took and left in its results folder."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from drivesplat.io.free_disk import free_bytes
from drivesplat.settings.blocks import drive_of
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.costs.measured import TRAIN, WORLD, Cost, JobId

NOT_KNOWN = "not known yet"
ROUGH_SECONDS, ROUGH_ITERATION = 10.0, {True: 0.006, False: 0.15}
"""Seconds of a job of any stage, and of a training's iteration with and without a GPU, on other machines. They are used
for what is not measured yet: a job may take a third or three times as long."""
MAX_PEERS = 20
"""Scenes whose files tell what a job leaves, at most: drives have hundreds of blocks."""
MEMBER_FOLDERS = {
    "masks.json": ".", "checkpoint.npz": "tensorboard", "parts.json": ".", "drive.json": ".", "scans.json": ".",
}  # fmt: skip
"""Outputs beside which a job writes files that no rule declares, and the folder of these."""


@dataclass(frozen=True)
class Machine:
    """What jobs are spread over."""

    cores: int
    gpus: int


@dataclass(frozen=True)
class PlannedJob:
    """A job that is to run: its threads, whether it takes a GPU, its declared outputs, and the seconds that it still
    takes (None: not measured)."""

    job: JobId
    threads: int
    on_gpu: bool
    outputs: tuple[str, ...] = ()
    seconds: float | None = None


class Expectations:
    """The expected costs of jobs of a `config`, given measured `costs`."""

    def __init__(self, config: Config, costs: Sequence[Cost]):
        self._config = config
        self._moving = {name for name, method in config.all_methods.items() if method.moving_parts}
        self._blocks: list[str] | None = None
        self._costs: dict[tuple[str, str], list[Cost]] = defaultdict(list)
        for cost in costs:
            self._costs[self._kind(cost.job)].append(cost)

    def of(self, job: JobId) -> tuple[float | None, set[JobId]]:
        """The median seconds of measured jobs, and these jobs: the job itself where it ran before; else those of its
        stage and method on other scenes of the dataset; else those of its stage. None where there are none. The seconds
        of a training are scaled with its iterations."""
        peers = self._costs.get(self._kind(job), [])
        alike: list[Callable[[Cost], bool]] = [
            lambda cost: cost.job == job,
            lambda cost: cost.job.method == job.method,
            lambda cost: job.stage != TRAIN or (cost.job.method in self._moving) == (job.method in self._moving),
        ]
        for like in alike:
            found = {c.job: seconds for c in peers if like(c) and (seconds := self._scaled(c, job)) is not None}
            if found:
                return statistics.median(found.values()), set(found)
        return None, set()

    def rough_seconds(self, planned: PlannedJob) -> float:
        """The seconds of a job by those of other machines."""
        job = planned.job
        if job.stage != TRAIN:
            return ROUGH_SECONDS
        iterations = for_scene(self._config, job.scene, job.method).train.iterations
        return ROUGH_SECONDS + iterations * ROUGH_ITERATION[planned.on_gpu]

    def disk_bytes(self, planned: PlannedJob, results: Path) -> float | None:
        """Bytes that a job will add to the results folder: none where it replaces files, else the median of what it
        left for the other scenes of the dataset, None where there is nothing."""
        if _size(planned.outputs):
            return 0.0
        scene = planned.job.scene
        places = [
            path.relative_to(results / scene) for path in map(Path, planned.outputs) if results / scene in path.parents
        ]
        peers = [other for other in self._known_scenes(scene, results) if other != scene]
        sizes = (size for other in peers if (size := _size(results / other / place for place in places)))
        known = list(islice(sizes, MAX_PEERS))
        return statistics.median(known) if known else None

    def _kind(self, job: JobId) -> tuple[str, str]:
        """The stage and dataset of a job, whose jobs are compared; a synthetic world is compared with no other."""
        return job.stage, job.film if job.stage == WORLD else self._dataset(job.scene)

    def _known_scenes(self, scene: str, results: Path) -> list[str]:
        """The scenes of the same dataset; for a block all blocks of drives of its dataset that have results."""
        if self._config.is_block(scene):
            if self._blocks is None:
                every = (path.name for path in sorted(results.glob("*.*")))
                self._blocks = [name for name in every if self._config.is_block(name)]
            return [name for name in self._blocks if self._dataset(name) == self._dataset(scene)]
        return [other for other in self._config.scenes if self._dataset(other) == self._dataset(scene)]

    def _dataset(self, scene: str) -> str:
        """A scene's dataset, empty for jobs of no scene; a scene that is no longer configured has one of its own.
        Blocks are compared with blocks of the same dataset, and drives that are cut into blocks with such drives."""
        if self._config.is_block(scene):
            return f"blocks of {self._config.dataset_of(scene)}"
        return self._config.dataset_names.get(scene, f"?{scene}" if scene else "")

    def _scaled(self, cost: Cost, job: JobId) -> float | None:
        if job.stage != TRAIN:
            return cost.seconds
        iterations = for_scene(self._config, job.scene, job.method).train.iterations
        return cost.seconds * iterations / cost.iterations if cost.iterations else None


def _size(files: Iterable[str | Path]) -> float:
    """Bytes of these files and of those that their jobs wrote beside them; 0 where there are none."""
    found: set[Path] = set()
    for path in (Path(file) for file in files if Path(file).is_file()):
        found.add(path)
        if path.name in MEMBER_FOLDERS:
            found |= {file for file in (path.parent / MEMBER_FOLDERS[path.name]).rglob("*") if file.is_file()}
    states = [file.stat() for file in found]
    return float(sum({(state.st_dev, state.st_ino): state.st_size for state in states}.values()))  # hard links once


def wall_seconds(planned: Iterable[PlannedJob], machine: Machine) -> float:
    """A lower bound of the time that jobs of known seconds take: cores are never idle, each GPU has one job, and a
    method's training waits for its scene's stages, that of a block also for those of its drive. Close where there is
    more work than machine."""
    jobs = [(one, one.seconds) for one in planned if one.seconds is not None]
    busy = sum(seconds * min(one.threads, machine.cores) for one, seconds in jobs) / max(1, machine.cores)
    on_gpus = sum(seconds for one, seconds in jobs if one.on_gpu) / max(1, machine.gpus)
    own, trainings, longest = (defaultdict[tuple[str, str], float](float) for _ in range(3))
    for one, seconds in jobs:
        place = one.job.scene, one.job.method
        if not one.job.method:
            own[place] += seconds
        elif one.job.stage == TRAIN:
            trainings[place] += seconds
        else:
            longest[place] = max(longest[place], seconds)
    of_drives = {scene: own[drive_of(scene), ""] for scene, _ in {*own, *trainings} if drive_of(scene) != scene}
    before = {scene: own[scene, ""] + of_drives.get(scene, 0.0) for scene, _ in {*own, *trainings, *longest}}
    chains = [before[scene] + trainings[scene, m] + longest[scene, m] for scene, m in {*own, *trainings, *longest}]
    return max([busy, on_gpus, *chains])


@dataclass(frozen=True)
class Estimate:
    """The expected wall time (s) of those of a run's `jobs` that are `known` from `measured` jobs, and a rough one of
    all; per stage the number of jobs and the mean seconds of the known ones (None: not measured), the dearest first;
    the bytes that the run adds, without those of `unknown_disk` jobs, and the free bytes."""

    jobs: int
    seconds: float
    rough_seconds: float
    known: int
    measured: int
    by_stage: dict[str, tuple[int, float | None]]
    machine: Machine
    disk: float
    unknown_disk: int
    free_disk: float


def estimate(planned: Sequence[PlannedJob], expectations: Expectations, machine: Machine, results: Path) -> Estimate:
    """The estimate of `planned` jobs in a results folder."""
    expected = [expectations.of(one.job) for one in planned]
    stages: dict[str, list[float | None]] = defaultdict(list)
    for one, (seconds, _) in zip(planned, expected, strict=True):
        stages[one.job.stage].append(seconds)
    known = {stage: [value for value in values if value is not None] for stage, values in stages.items()}
    longest_first = sorted(stages, key=lambda stage: -sum(known[stage]))
    disk = [expectations.disk_bytes(one, results) for one in planned]
    jobs = [replace(one, seconds=seconds) for one, (seconds, _) in zip(planned, expected, strict=True)]
    rough = [one if one.seconds is not None else replace(one, seconds=expectations.rough_seconds(one)) for one in jobs]
    return Estimate(
        jobs=len(planned),
        seconds=wall_seconds(jobs, machine),
        rough_seconds=wall_seconds(rough, machine),
        known=sum(map(len, known.values())),
        measured=len(set().union(*(measured for _, measured in expected))),
        by_stage={s: (len(stages[s]), statistics.fmean(known[s]) if known[s] else None) for s in longest_first},
        machine=machine,
        disk=sum((size or 0.0 for size in disk), 0.0),
        unknown_disk=disk.count(None),
        free_disk=float(free_bytes(results)),
    )


def in_one_line(found: Estimate) -> str:
    """'27 jobs, about 12 min on 4 cores (from 22 measured jobs), about 0.4 GB of disk (…)'. The jobs whose time is not
    known are counted beside it, with a rough time of all; without any measured job it stands alone."""
    if not found.jobs:
        return "nothing is to be run"
    cores, gpus = found.machine.cores, found.machine.gpus
    where = f"{cores} core{'s' * (cores > 1)}" + (f" and {gpus} GPUs" if gpus > 1 else "")
    rough, rest = f"very roughly {spelled(found.rough_seconds)}", found.jobs - found.known
    time = f"{rough} on {where} (by other machines: no such job has run here before)"
    if found.known:
        time = f"about {spelled(found.seconds)} on {where} (from {found.measured} measured "
        time += f"job{'s' * (found.measured > 1)})"
    if found.known and rest:
        time += f" without {counted(rest)} whose time is {NOT_KNOWN}, {rough} in all"
    free = f"{found.free_disk / 1e9:.1f} GB free"
    missing = f"; without {counted(found.unknown_disk)} whose size is {NOT_KNOWN}" if found.unknown_disk else ""
    warning = "; that is more than there is" if found.disk > found.free_disk else ""
    size = f"{found.disk / 1e9:.1f} GB" if found.disk >= 1e9 else f"{found.disk / 1e6:.0f} MB"
    disk = f"about {size} of disk ({free}{missing}){warning}"
    if found.unknown_disk == found.jobs:
        disk = f"disk use {NOT_KNOWN} ({free})"
    return f"{counted(found.jobs)}, {time}, {disk}"


def counted(count: int) -> str:
    """'1 job', '3 jobs'."""
    return f"{count} job{'s' * (count != 1)}"


def in_full(found: Estimate) -> str:
    """The line, and a table of stages."""
    lines = [f"drivesplat: {in_one_line(found)}"]
    for stage, (jobs, seconds) in found.by_stage.items():
        lines.append(f"  {stage:<16}{jobs:>5} x {NOT_KNOWN if seconds is None else f'{seconds:>8.1f} s'}")
    return "\n".join(lines)


def spelled(seconds: float) -> str:
    """'45 s', '12 min', '3 h 5 min'."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
