"""costs.csv and costs.json: a row per job that has run, and the total of each scene."""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from drivesplat.io.storage import write_csv, write_json
from drivesplat.settings.blocks import drive_of
from drivesplat.workflow.costs.measured import TRAIN, Cost, read_costs

FILES = ("costs.csv", "costs.json")
LIMIT_SECONDS = 90 * 60.0
"""Target for the time of a scene; reported, not enforced."""
ABLATION = "ablation"
PEAKS = ("max_rss_mb", "gpu_memory_gb")
COLUMNS = (
    "scene", "method", "stage", "film", "seconds", "seconds_from", "max_rss_mb", "cpu_seconds", "mean_load",
    "gpu_memory_gb", "device", "scene_under_90_minutes",
)  # fmt: skip


def scene_totals(
    costs: Sequence[Cost], methods: Collection[str], of_scenes: Mapping[str, Collection[str]] | None = None
) -> list[dict[str, Any]]:
    """The summed costs of each scene's jobs, which follow each other in `costs`, and whether they are under 90 minutes.
    Counts the scene's stages and its methods, without ablation variants: those that `of_scenes` has for it, otherwise
    `methods`. `complete`: whether all of them have been trained."""
    totals, every = [], methods
    for scene, own in groupby(costs, key=lambda c: c.job.scene):
        methods = (of_scenes or {}).get(scene, every)
        counted = [c for c in own if c.job.method in methods or (not c.job.method and c.job.stage != ABLATION)]
        if not scene or not counted:
            continue
        seconds = sum(c.seconds for c in counted)
        trainings = [c for c in counted if c.job.stage == TRAIN]
        memory = {name: [v for c in counted if (v := getattr(c, name)) is not None] for name in PEAKS}
        totals.append(
            {
                "scene": scene,
                "jobs": len(counted),
                "seconds": seconds,
                "training_seconds": sum((c.seconds for c in trainings), 0.0),
                "seconds_by_method": {m: sum((c.seconds for c in counted if c.job.method == m), 0.0) for m in methods},
                "scene_seconds": sum((c.seconds for c in counted if not c.job.method), 0.0),
                **{name: max(values, default=None) for name, values in memory.items()},
                "under_90_minutes": seconds < LIMIT_SECONDS,
                "complete": {c.job.method for c in trainings} == set(methods),
            }
        )
    return totals


def drive_totals(
    results: Path, costs: Sequence[Cost], scenes: Sequence[dict[str, Any]], cut: Collection[str]
) -> list[dict[str, Any]]:
    """The summed costs of each of the drives that are `cut` into blocks, over itself and its blocks: the number of
    `blocks`, `seconds` of all their jobs and of trainings, the largest peaks of memory, and `bytes` on disk."""
    totals = []
    for drive in cut:
        own = [total for total in scenes if drive_of(total["scene"]) == drive]
        names = {cost.job.scene for cost in costs if drive_of(cost.job.scene) == drive}
        folders = [results / name for name in names]
        totals.append(
            {
                "drive": drive,
                "blocks": len(names - {drive}),
                **{key: sum((total[key] for total in own), 0.0) for key in ("seconds", "training_seconds")},
                **{key: max((t[key] for t in own if t[key] is not None), default=None) for key in PEAKS},
                "bytes": sum(file.lstat().st_size for at in folders for file in at.rglob("*") if file.is_file()),
            }
        )
    return totals


def costs_record(
    results: Path,
    methods: Collection[str],
    of_scenes: Mapping[str, Collection[str]] | None = None,
    cut: Collection[str] = (),
) -> dict[str, Any]:
    """The content of costs.json: `rows` as in costs.csv, totals of `scenes` and of `drives` that are `cut` into blocks,
    and sentences about `unreadable` files; other arguments as of `scene_totals`."""
    costs, complaints = read_costs(results)
    scenes = scene_totals(costs, methods, of_scenes)
    under = {total["scene"]: total["under_90_minutes"] for total in scenes}
    known = [{**vars(cost.job), **vars(cost), COLUMNS[-1]: under.get(cost.job.scene)} for cost in costs]
    rows = [{name: row[name] for name in COLUMNS} for row in known]
    drives = drive_totals(results, costs, scenes, cut)
    return {"rows": rows, "scenes": scenes, "drives": drives, "unreadable": complaints}


def write_costs(
    results: Path,
    methods: Collection[str],
    of_scenes: Mapping[str, Collection[str]] | None = None,
    cut: Collection[str] = (),
) -> dict[str, Any]:
    """Writes costs.csv and costs.json; returns the latter's content. Arguments as of `costs_record`.

    Raises ResultError where they cannot be written.
    """
    record = costs_record(results, methods, of_scenes, cut)
    spelled = {None: None, True: "true", False: "false"}
    csv_rows = [{**row, COLUMNS[-1]: spelled[row[COLUMNS[-1]]]} for row in record["rows"]]
    write_csv(results / FILES[0], COLUMNS, csv_rows)
    write_json(results / FILES[1], record)
    return record


def finding(total: dict[str, Any]) -> str:
    """A scene's total in words: '87 min, under 90'."""
    so_far = "" if total["complete"] else " so far"
    return f"{total['seconds'] / 60:.1f} min{so_far}, {'under' if total['under_90_minutes'] else 'not under'} 90"


def costs_in_words(record: dict[str, Any]) -> str:
    """A line per scene and per drive that is cut into blocks, and one per file that could not be read."""
    lines = [f"{total['scene']}: {finding(total)} ({total['jobs']} jobs)" for total in record["scenes"]]
    lines += [_of_drive(total) for total in record["drives"]]
    return "\n".join([*(lines or ["no job of a scene has been measured yet"]), *record["unreadable"]])


def _of_drive(total: dict[str, Any]) -> str:
    """The costs of a drive that is cut into blocks in words."""
    memory = total["gpu_memory_gb"]
    peak = "" if memory is None else f", at most {memory:.1f} GB of GPU memory"
    return (
        f"drive {total['drive']} with {total['blocks']} blocks: {total['seconds'] / 60:.1f} min of jobs, "
        f"{total['training_seconds'] / 60:.1f} of them trainings{peak}, {total['bytes'] * 1e-9:.2f} GB on disk"
    )
