"""The report across scenes: the gap between static and moving pixels, a row per scene and method."""

from pathlib import Path
from typing import Any

from drivesplat import storage
from drivesplat.errors import ResultError
from drivesplat.holdout import HELD_OUT_GROUPS
from drivesplat.provenance import differences
from drivesplat.storage import read_json, unreadable

SCHEMA = 1
REGIONS = ("static", "vehicle", "moving_vehicle")


def gap_report(paths: list[str], expected: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The content of gap_report.json from the metrics.json files of measured scenes.

    `expected` gives for every configured scene the settings and code its metrics should come from: a result made
    otherwise, or measured under another protocol than the first, is left out and named under `left_out`. `missing`
    names the configured scenes without a result.
    """
    rows: list[dict[str, Any]] = []
    left_out: list[dict[str, str]] = []
    measured: dict[str, Any] = {}
    for path in paths:
        try:
            record = read_json(path, rule="scene_metrics")
            scene = record["scene"]
            reasons = _mismatches(record, expected, measured)
            scene_rows = [_row(record, method) for method in record["methods"]]
        except ResultError as error:
            left_out.append({"scene": Path(path).parent.name, "why": str(error)})
            continue
        except (AttributeError, KeyError, TypeError) as error:
            why = unreadable(path, "scene_metrics", f"not the metrics of a scene ({type(error).__name__}: {error})")
            left_out.append({"scene": Path(path).parent.name, "why": str(why)})
            continue
        if reasons:
            left_out.append({"scene": scene, "why": "; ".join(reasons)})
            continue
        measured[scene] = _comparable(record)
        rows += scene_rows
    named = {*measured, *(item["scene"] for item in left_out)}
    missing = [{"scene": scene, "why": "not measured"} for scene in expected if scene not in named]
    return {"schema": SCHEMA, "rows": rows, "means": _means(rows), "left_out": left_out, "missing": missing}


def write_csv(path: str | Path, report: dict[str, Any]) -> None:
    """The rows of a report as a table; empty cells where a figure is null."""
    storage.write_csv(path, COLUMNS, report["rows"])


def console_table(report: dict[str, Any]) -> str:
    """A report for the console: both groups, a line per scene and method, then what is missing and why."""
    header = ["scene", "method"]
    for group in HELD_OUT_GROUPS:
        header += [f"{group[:6]}. static", "vehicle", "moving", "gap dB"]
    lines = [header]
    for row in [*report["rows"], *report["means"]]:
        cells = [row["scene"], row["method"]]
        for group in HELD_OUT_GROUPS:
            cells += [_figure(row[f"{group}_{name}"]) for name in ("static", "vehicle", "moving_vehicle", "gap_db")]
        lines.append(cells)
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
    notes = [f"{item['scene']}: left out ({item['why']})" for item in report["left_out"]]
    notes += [f"{item['scene']}: {item['why']}" for item in report["missing"]]
    return "\n".join(["PSNR on held-out frames", *table, *notes])


COLUMNS = (
    "scene", "dataset", "method",
    *(f"{group}_{name}" for group in HELD_OUT_GROUPS for name in (*REGIONS, "gap_db", "lpips")),
    "gaussians", "train_seconds",
)  # fmt: skip


def _mismatches(record: dict[str, Any], expected: dict[str, Any], measured: dict[str, Any]) -> list[str]:
    scene = record["scene"]
    if scene not in expected:
        return ["not in the config"]
    reasons = differences(expected[scene], record["provenance"]["stages"])
    own = _comparable(record)
    for other, protocol in measured.items():
        unlike = [key for key in _COMPARABLE if protocol[key] != own[key]]
        if unlike:
            reasons.append(f"its protocol differs from that of scene {other}: {', '.join(unlike)}")
        break
    return reasons


_COMPARABLE = ("cameras", "eval_camera", "width", "height", "sweeps", "holdout", "poses", "regions")


def _comparable(record: dict[str, Any]) -> dict[str, Any]:
    """What of a protocol has to be the same for figures to stand side by side. A scene whose refinement was refused
    keeps its poses (`protocol.poses` says so) and stands beside those that have refined ones."""
    poses = {"poses": "refined"} if "refine_poses" in record["provenance"]["stages"] else {}
    return {key: record["protocol"][key] for key in _COMPARABLE} | poses


def _row(record: dict[str, Any], method: str) -> dict[str, Any]:
    result = record["methods"][method]
    row = {"scene": record["scene"], "dataset": record["dataset"], "method": method}
    for group in HELD_OUT_GROUPS:
        for region in REGIONS:
            row[f"{group}_{region}"] = result[group][region]["psnr"] if result[group][region] else None
        row[f"{group}_gap_db"] = result[group]["gap_db"]
        row[f"{group}_lpips"] = result[group]["all"]["lpips"] if result[group]["all"] else None
    return {**row, "gaussians": result["gaussians"], "train_seconds": result["train_seconds"]}


def _means(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The mean of every figure over scenes, a row per method; null figures do not count."""
    means = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mean: dict[str, Any] = {"scene": "mean", "dataset": "", "method": method}
        for column in COLUMNS[3:]:
            values = [row[column] for row in rows if row["method"] == method and row[column] is not None]
            mean[column] = sum(values) / len(values) if values else None
        means.append(mean)
    return means


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
