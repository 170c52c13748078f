"""How much disk a run will fill: what the same jobs left on it for other scenes."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesplat.io.free_disk import free_bytes
from drivesplat.workflow.costs.measured import Job

BESIDE = {"masks.json": ".", "checkpoint.pt": "tensorboard", "parts.json": "."}
"""Outputs beside which a job leaves a folder's files that no rule declares, and which folder."""


@dataclass(frozen=True)
class Leaves:
    """A job, and the files that it makes."""

    job: Job
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class DiskNeed:
    """Bytes that a run will add, of how many jobs that is rough, and the bytes that are free."""

    needed: float
    rough: int
    free: float


def disk_need(
    results: Path, jobs: Iterable[Leaves], peers: Callable[[str], Sequence[str]], usual: Callable[[Job], float]
) -> DiskNeed:
    """What `jobs` will add in the folder of results: nothing where they replace what is there, else the median of what
    they left for the `peers` of their scenes, the others of the dataset; else the bytes that are `usual`."""
    needed, rough = 0.0, 0
    for one in jobs:
        if _left(one.outputs):
            continue
        elsewhere = (_elsewhere(results, one, scene) for scene in peers(one.job.scene))
        known = [size for outputs in elsewhere if (size := _left(outputs))]
        rough += not known
        needed += statistics.median(known) if known else usual(one.job)
    return DiskNeed(needed, rough, float(free_bytes(results)))


def _elsewhere(results: Path, one: Leaves, scene: str) -> list[str]:
    """The files of the same job of another scene."""
    own = (results / one.job.scene, results / scene)
    inside = [path for path in map(Path, one.outputs) if path.is_relative_to(own[0])]
    return [str(own[1] / path.relative_to(own[0])) for path in inside]


def _left(outputs: Sequence[str]) -> float:
    """Bytes of these files and of what lies beside them; 0 where none is there."""
    files: set[Path] = set()
    for path in (Path(output) for output in outputs if Path(output).is_file()):
        files.add(path)
        if path.name in BESIDE:
            files |= {file for file in (path.parent / BESIDE[path.name]).rglob("*") if file.is_file()}
    return float(sum(file.stat().st_size for file in files))
