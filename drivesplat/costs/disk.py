"""How much disk a run will fill: as much as the folders of scenes and methods that are there already."""

import shutil
import statistics
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

SCENE_BYTES, METHOD_BYTES = 60e6, 120e6
"""Of a scene's folder without its methods, and of a method's: where no other scene tells. A tenth to a half of it is
what the scenes and methods of nuScenes mini and of the demo take; films and exports included."""


@dataclass(frozen=True)
class DiskNeed:
    """Bytes that a run will add, how many folders' sizes were known from others, how many were not, and bytes free."""

    needed: float
    measured: int
    rough: int
    free: float


def disk_need(results: Path, folders: Iterable[tuple[str, str]], dataset: Callable[[str], str]) -> DiskNeed:
    """What is still to come into the `folders`, scenes with methods (empty: of the scene itself), of jobs that will
    run: each gets as large as the median of those of other scenes of its dataset, else as is usual."""
    there = sizes(results)
    needed, measured, rough = 0.0, 0, 0
    for scene, method in dict.fromkeys(folders):
        peers = {
            place: size for place, size in there.items() if place[0] != scene and dataset(place[0]) == dataset(scene)
        }
        same = [size for place, size in peers.items() if place[1] == method]
        alike = same or [size for place, size in peers.items() if bool(place[1]) == bool(method)]
        measured, rough = measured + bool(alike), rough + (not alike)
        expected = statistics.median(alike) if alike else METHOD_BYTES if method else SCENE_BYTES
        needed += max(0.0, expected - there.get((scene, method), 0.0))
    existing = next(folder for folder in (results.absolute(), *results.absolute().parents) if folder.is_dir())
    return DiskNeed(needed, measured, rough, shutil.disk_usage(existing).free)


def sizes(results: Path) -> dict[tuple[str, str], float]:
    """Bytes in the folders of all scenes, by scene and method; a folder counts as a scene's by its scene.json, one in
    it as a method's by its checkpoint.pt."""
    found: dict[tuple[str, str], float] = {}
    for record in results.glob("*/scene.json"):
        folder = record.parent
        methods = [checkpoint.parent for checkpoint in folder.glob("*/checkpoint.pt")]
        whole = _bytes_in(folder)
        of_methods = {(folder.name, method.name): _bytes_in(method) for method in methods}
        found |= of_methods
        found[folder.name, ""] = whole - sum(of_methods.values())
    return found


def _bytes_in(folder: Path) -> float:
    total = 0
    for file in folder.rglob("*"):
        try:
            total += file.lstat().st_size
        except OSError:
            continue  # a job at work has renamed it
    return float(total)
