"""The main figures of metrics.json files in one table of text, a row for each scene and method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.evaluation.comparison import GROUP_PLACES, values_at
from drivesplat.io.storage import read_json, unreadable

METRICS_FILE = "metrics.json"
LEGEND = "PSNR of held-out images in dB; the gap is that of static pixels less that of moving vehicles"
SCAN_LEGEND = "; range: median error of held-out LiDAR scans in cm"
WIDTH = 9
"""Characters of a column of figures."""


@dataclass(frozen=True)
class Column:
    """A figure below `keys` of a group of held-out frames, with its `heading`, factor and decimal places."""

    heading: str
    keys: tuple[str, ...]
    scale: float = 1.0
    decimals: int = 1


STATIC, MOVING = Column("static", ("static", "psnr")), Column("moving", ("moving_vehicle", "psnr"))
GAP = Column("gap", ("gap_db",))
RANGE = Column("range", ("lidar", "all", "range_error_median_m"), scale=100.0)


def metrics_of(path: str | Path) -> tuple[Path, dict[str, Any]]:
    """The metrics of a scene, by its folder or the file itself, and the file. Raises ResultError where it is missing,
    damaged or something else."""
    given = Path(path)
    file = given if given.suffix == ".json" else given / METRICS_FILE
    if not file.exists():
        raise ResultError(f"{file} is missing; make it with `snakemake --cores 4 {file}`, or name a scene that has it")
    record = read_json(file, rule="scene_metrics")
    if not (isinstance(record, dict) and "scene" in record and isinstance(record.get("methods"), dict)):
        raise unreadable(file, "scene_metrics", "not the metrics of a scene")
    return file, record


def figures_table(records: Sequence[dict[str, Any]]) -> list[str]:
    """The lines of the table: its legend, groups of held-out frames, headings, and a row for each scene and method.
    Groups and columns without any figure are left out. Empty where there is none at all."""
    rows = [(str(record["scene"]), name, method) for record in records for name, method in record["methods"].items()]
    methods = [method for *_, method in rows]
    groups = {group: [c for c in (STATIC, MOVING, GAP, RANGE) if _has(methods, group, c)] for group in GROUP_PLACES}
    groups = {group: columns for group, columns in groups.items() if columns}
    if not groups:
        return []
    widths = {group: max(WIDTH * len(columns), len(GROUP_PLACES[group]) + 2) for group, columns in groups.items()}
    scenes, names = (max(map(len, (title, *(row[i] for row in rows)))) for i, title in enumerate(("scene", "method")))

    def line(scene: str, method: str, cells: Callable[[str], Sequence[str]]) -> str:
        of_groups = ("".join(cell.rjust(WIDTH) for cell in cells(group)).rjust(widths[group]) for group in groups)
        return f"{scene:<{scenes}}  {method:<{names}}" + "".join(of_groups)

    return [
        LEGEND + SCAN_LEGEND * any(RANGE in columns for columns in groups.values()),
        line("", "", lambda group: [GROUP_PLACES[group]]),
        line("scene", "method", lambda group: [column.heading for column in groups[group]]),
        *(
            line(scene, name, lambda group, of=method: [_cell(of, group, column) for column in groups[group]])
            for scene, name, method in rows
        ),
    ]


def _has(methods: Sequence[dict[str, Any]], group: str, column: Column) -> bool:
    return any(_value(method, group, column) is not None for method in methods)


def _value(method: dict[str, Any], group: str, column: Column) -> float | None:
    """A figure; no gap without moving vehicles, where `gap_db` compares parked ones."""
    if column is GAP and _value(method, group, MOVING) is None:
        return None
    return values_at([method], group, *column.keys)[0]


def _cell(method: dict[str, Any], group: str, column: Column) -> str:
    value = _value(method, group, column)
    return "-" if value is None else f"{column.scale * value:.{column.decimals}f}"
