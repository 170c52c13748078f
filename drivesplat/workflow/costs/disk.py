"""How much disk a run will fill: what the same jobs left on it for other scenes."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesplat.io.free_disk import free_bytes
from drivesplat.workflow.costs.measured import JobId

MEMBER_FOLDERS = {"masks.json": ".", "checkpoint.npz": "tensorboard", "parts.json": "."}
"""Outputs beside which a job leaves files that no rule declares, and the folder of these."""


@dataclass(frozen=True)
class DiskNeed:
    """Bytes that a run will add, how many of its jobs are not in them since nothing was measured, and free bytes."""

    needed: float
    unknown: int
    free: float


def disk_need(
    results: Path, jobs: Iterable[tuple[JobId, Sequence[str]]], peers: Callable[[str], Sequence[str]]
) -> DiskNeed:
    """The bytes that `jobs`, each with its outputs, will add to the results folder: none where they replace files,
    else the median of what the same job left for the `peers` of its scene, the others of the dataset."""
    needed, unknown = 0.0, 0
    for job, outputs in jobs:
        if _left(outputs):
            continue
        elsewhere = (_elsewhere(results, job, outputs, scene) for scene in peers(job.scene))
        known = [size for files in elsewhere if (size := _left(files))]
        unknown += not known
        needed += statistics.median(known) if known else 0.0
    return DiskNeed(needed, unknown, float(free_bytes(results)))


def _elsewhere(results: Path, job: JobId, outputs: Sequence[str], scene: str) -> list[str]:
    """The files of the same job of another scene."""
    own = results / job.scene
    return [str(results / scene / path.relative_to(own)) for path in map(Path, outputs) if path.is_relative_to(own)]


def _left(outputs: Sequence[str]) -> float:
    """Bytes of these files and of their undeclared members; 0 where there are none."""
    files: set[Path] = set()
    for path in (Path(output) for output in outputs if Path(output).is_file()):
        files.add(path)
        if path.name in MEMBER_FOLDERS:
            files |= {file for file in (path.parent / MEMBER_FOLDERS[path.name]).rglob("*") if file.is_file()}
    return float(sum(file.stat().st_size for file in files))
