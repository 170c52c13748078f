"""How much disk a run will fill: what the same jobs left on it for other scenes."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesplat.free_disk import free_bytes

MEGABYTES = {
    "demo_world": 80.0, "extract": 2.0, "lidar_seed": 15.0, "parser": 5.0, "masks": 5.0, "actors": 2.0,
    "lidar_depth": 10.0, "free_space": 5.0, "train": 110.0, "film": 5.0, "film_parts": 10.0, "edit": 10.0,
    "ghost_panel": 2.0, "remove_actor": 8.0, "evaluate": 2.0, "export": 200.0, "export_usd": 60.0,
    "export_viewer": 15.0, "gap_report": 10.0,
}  # fmt: skip
"""Of what stages leave at the defaults: 0.4 million Gaussians, 59 numbers each in checkpoint.pt and splat.ply."""
OTHERS = 1.0
BESIDE = {"masks.json": ".", "checkpoint.pt": "tensorboard", "parts.json": "."}
"""Outputs beside which a job leaves a folder's files that no rule declares, and which folder."""


@dataclass(frozen=True)
class Leaves:
    """A job of a `stage` and `scene` (empty: of none), and the files that it makes."""

    stage: str
    scene: str
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class DiskNeed:
    """Bytes that a run will add, of how many jobs that is rough, and the bytes that are free."""

    needed: float
    rough: int
    free: float


def disk_need(results: Path, jobs: Iterable[Leaves], peers: Callable[[str], Sequence[str]]) -> DiskNeed:
    """What `jobs` will add in the folder of results: nothing where they replace what is there, else the median of what
    they left for the `peers` of their scenes, the others of the dataset; else what is usual."""
    needed, rough = 0.0, 0
    for job in jobs:
        if _left(job.outputs):
            continue
        elsewhere = (_elsewhere(results, job, scene) for scene in peers(job.scene))
        known = [size for outputs in elsewhere if (size := _left(outputs))]
        rough += not known
        needed += statistics.median(known) if known else 1e6 * MEGABYTES.get(job.stage, OTHERS)
    return DiskNeed(needed, rough, float(free_bytes(results)))


def _elsewhere(results: Path, job: Leaves, scene: str) -> list[str]:
    """The files of the same job of another scene."""
    own = (results / job.scene, results / scene)
    inside = [path for path in map(Path, job.outputs) if path.is_relative_to(own[0])]
    return [str(own[1] / path.relative_to(own[0])) for path in inside]


def _left(outputs: Sequence[str]) -> float:
    """Bytes of these files and of what lies beside them; 0 where none is there."""
    files: set[Path] = set()
    for path in (Path(output) for output in outputs if Path(output).is_file()):
        files.add(path)
        if path.name in BESIDE:
            files |= {file for file in (path.parent / BESIDE[path.name]).rglob("*") if file.is_file()}
    return float(sum(file.stat().st_size for file in files))
