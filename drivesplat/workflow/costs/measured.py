"""The measured cost of every job that has run, from Snakemake's benchmark files and the records of trainings."""

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from drivesplat.settings.tracks import OTHER_TRACKS

BENCHMARKS = "benchmarks"
"""The folder of benchmark files in that of the results."""
TRAIN, FILM, EDIT, QUAD, FILM_PARTS, WORLD = "train", "film", "edit", "quad", "film_parts", "demo_world"
DRIVE, SCANS = "drive_folder", "scan_folder"
COLUMNS = {"max_rss_mb": "max_rss", "cpu_seconds": "cpu_time", "mean_load": "mean_load"}
"""Fields of a Cost and the columns of Snakemake's benchmark files that hold them."""
RENAMED = {"metrics": "scene_metrics"}
"""Stages whose benchmark file is called otherwise."""


@dataclass(frozen=True)
class JobId:
    """The identity of a job: stage, scene, method, and name of its film, edit or folder, each empty where it has
    none. For the job that generates a synthetic world, `film` is the dataset; for a job about other tracks than the
    annotated ones, the folder of its results."""

    stage: str
    scene: str = ""
    method: str = ""
    film: str = ""

    @classmethod
    def of(cls, benchmark: PurePath) -> "JobId":
        """The job of a benchmark file, given by its path relative to the folder of benchmarks."""
        *place, name = benchmark.with_suffix("").parts
        if place == [WORLD]:
            return cls(WORLD, film=name)
        if place and place[-1] in OTHER_TRACKS:
            return cls(name, place[0], film=place[-1])
        scene, method = [*place, "", ""][:2]
        for stage in (FILM, EDIT, QUAD, DRIVE, SCANS):
            if method and name.startswith(f"{stage}_") and name != FILM_PARTS:
                return cls(stage, scene, method, name.removeprefix(f"{stage}_"))
        return cls(RENAMED.get(name, name), scene, method, "/".join(place[2:]))

    @property
    def name(self) -> str:
        """The job in words: '0103 street train'."""
        return " ".join(word for word in (self.scene, self.method, self.stage, self.film) if word)


@dataclass(frozen=True)
class Cost:
    """The cost of a job: wall time of the whole job or, for a training that was resumed or has no benchmark, of the
    training loop (`seconds_from` tells which), and peak memory. None: unknown."""

    job: JobId
    seconds: float
    seconds_from: str
    max_rss_mb: float | None = None
    cpu_seconds: float | None = None
    mean_load: float | None = None
    gpu_memory_gb: float | None = None
    device: str | None = None
    iterations: int | None = None


def read_costs(results: Path) -> tuple[list[Cost], list[str]]:
    """The costs of the jobs of a results folder, sorted by name, and a sentence for each file that is missing or cannot
    be read, whose figures are left out."""
    costs, complaints = [], []
    folder = results / BENCHMARKS
    files = {JobId.of(file.relative_to(folder)): file for file in sorted(folder.rglob("*.tsv"))}
    trained = {JobId(TRAIN, *file.parent.parts[-2:]): file for file in sorted(results.glob("*/*/train.json"))}
    for job in sorted({*files, *trained}, key=lambda job: (job.scene, job.method, job.stage, job.film)):
        benchmark = _reading(_benchmark, files.get(job), complaints) or {}
        summary, resumed = _reading(_summary, trained.get(job), complaints) or ({}, False)
        if job in trained and job not in files:
            complaints.append(f"{trained[job]}: its job left no benchmark; only the training loop's seconds are known")
        # a benchmark covers only the last process of a resumed training
        fields = benchmark | summary if resumed else summary | benchmark
        if fields:
            costs.append(Cost(job, **fields))
    return costs, complaints


def _reading(reader: Any, path: Path | None, complaints: list[str]) -> Any:
    if path is None:
        return None
    try:
        return reader(path)
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        complaints.append(f"{path}: not readable, and left out ({type(error).__name__}: {error})")
        return None


def _benchmark(path: Path) -> dict[str, Any]:
    """The fields of a Cost in the last line of a benchmark file, None for '-' and 'NA': Snakemake measured nothing."""
    with open(path, encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file, delimiter="\t"))
    if not lines:
        raise ValueError("no line of figures")
    last = lines[-1]
    seconds = _figure(last["s"])
    if seconds is None:
        raise ValueError(f"{last['s']!r} are no seconds")
    figures = {field: _figure(last.get(column)) for field, column in COLUMNS.items()}
    return {"seconds": seconds, "seconds_from": "benchmark", **figures}


def _figure(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) and value >= 0 else None


def _summary(path: Path) -> tuple[dict[str, Any], bool]:
    """The fields of a Cost in train.json, and whether the training was resumed."""
    content = json.loads(path.read_text(encoding="utf-8"))
    memory = content["peak_gpu_memory_gb"]
    fields = {
        "seconds": float(content["seconds"]),
        "seconds_from": "train.json",
        "iterations": int(content["iterations"]),
        "gpu_memory_gb": None if memory is None else float(memory),
        "device": str(content["device"]),
    }
    return fields, bool(content["resumed_at"])
