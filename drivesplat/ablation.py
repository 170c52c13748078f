"""The stage `ablation`: what each thing in a method is worth, from trainings of the method without it."""

import csv
import io
from collections.abc import Iterator
from math import sqrt
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.holdout import HELD_OUT_GROUPS
from drivesplat.settings.ablation import AblationJob
from drivesplat.storage import atomic_write

FIGURES = ("static", "moving_vehicle", "gap_db")
"""What is compared in each group of held-out frames: the PSNR of two regions, and the gap; all in dB."""
COSTS = ("gaussians", "train_seconds")
WHERE = {"interpolation": "Between training frames", "extrapolation": "Beyond the last training frame"}


def ablation(evals: dict[str, dict[str, Any]], job: AblationJob) -> dict[str, Any]:
    """The content of ablation.json from the eval.json of every method of the ablation, by name, provenance aside.

    A row for the whole method (`without` is null), then one for every variant. Raises ResultError where two were
    measured under different protocols.
    """
    measured = side_by_side(evals)
    results = measured.pop("methods")
    runs_of = {without: [results[job.method(without, s)] for s in job.seeds] for without in (None, *job.without)}
    rows = [
        {"variant": job.variant(without), "without": without, **_row(runs, None if without is None else runs_of[None])}
        for without, runs in runs_of.items()
    ]
    return {**measured, **job.model_dump(mode="json", include={"of", "seeds"}), "rows": rows}


def figure(values: list[int | float | None]) -> dict[str, Any] | None:
    """Mean and spread (`min` to `max`) of a figure over the seeds in whose results it is not null; None where it is in
    all of them. `by_seed` are the values themselves."""
    there = [value for value in values if value is not None]
    if not there:
        return None
    return {"mean": mean(there), "min": min(there), "max": max(there), "by_seed": values}


def difference(values: list[float | None], whole: list[float | None]) -> dict[str, Any] | None:
    """By how much a variant's figure is above the whole method's: the `mean` of the differences between trainings with
    one seed, and its `standard_error` (None for a single seed); None where no seed has both."""
    differences = [None if a is None or b is None else a - b for a, b in zip(values, whole, strict=True)]
    there = [value for value in differences if value is not None]
    if not there:
        return None
    error = stdev(there) / sqrt(len(there)) if len(there) > 1 else None
    return {"mean": mean(there), "standard_error": error, "by_seed": differences}


def _row(runs: list[dict[str, Any]], whole: list[dict[str, Any]] | None) -> dict[str, Any]:
    """The figures of a variant's runs, one a seed, beside those of the whole method (None: these are the whole's)."""
    row: dict[str, Any] = {"seeds": len(runs)}
    for group in HELD_OUT_GROUPS:
        found = {name: _of(runs, group, name) for name in FIGURES}
        row[group] = {name: figure(values) for name, values in found.items()}
        row[group]["difference"] = {
            name: None if whole is None else difference(values, _of(whole, group, name))
            for name, values in found.items()
        }
    return row | {name: figure([run[name] for run in runs]) for name in COSTS}


def _of(runs: list[dict[str, Any]], group: str, name: str) -> list[float | None]:
    """A figure of every run; None where it is null, or its region is."""
    found = (run[group][name] for run in runs)
    return [value["psnr"] if isinstance(value, dict) else value for value in found]


def write_csv(path: str | Path, record: dict[str, Any]) -> None:
    """The rows of an ablation as a table; empty cells where a figure is null."""
    lines = [dict(_cells(row, record)) for row in record["rows"]]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(lines[0]))
    writer.writeheader()
    writer.writerows(lines)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def _cells(row: dict[str, Any], record: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The columns of a row and what stands there."""
    yield from (("scene", record["scene"]), ("variant", row["variant"]), ("seeds", row["seeds"]))
    for group in HELD_OUT_GROUPS:
        for name in FIGURES:
            found, off = row[group][name] or {}, row[group]["difference"][name] or {}
            yield from ((f"{group}_{name}{of}", found.get(key)) for of, key in _SPREAD.items())
            yield f"{group}_{name}_difference", off.get("mean")
            yield f"{group}_{name}_difference_standard_error", off.get("standard_error")
    for name in COSTS:
        yield from ((f"{name}{of}", (row[name] or {}).get(key)) for of, key in _SPREAD.items())


_SPREAD = {"": "mean", "_min": "min", "_max": "max"}


def markdown(record: dict[str, Any]) -> str:
    """An ablation in Markdown: how to read it, and a table for each group of held-out frames that was measured."""
    rows, seeds = record["rows"], ", ".join(map(str, record["seeds"]))
    head = (
        f"`{record['of']}` on scene {record['scene']}, random seeds {seeds}. PSNR in dB: mean over the seeds (least to "
        "greatest).\nDifference from the whole: mean of the differences seed by seed ± its standard error."
    )
    measured = [group for group in HELD_OUT_GROUPS if any(row[group][name] for row in rows for name in FIGURES)]
    return "\n\n".join([head, *(_table(rows, group) for group in measured)])


def _table(rows: list[dict[str, Any]], group: str) -> str:
    """The table of a group of held-out frames."""
    lines = [["without", "static", "difference", "moving vehicles", "difference", "gap", "Gaussians", "training"]]
    lines.append(["---"] * len(lines[0]))
    for row in rows:
        cells = [f"`{row['without']}`" if row["without"] else "nothing"]
        for name in ("static", "moving_vehicle"):
            cells += [_with_spread(row[group][name]), _with_error(row[group]["difference"][name])]
        cells += [_number(row[group]["gap_db"], "{:.1f}")]
        lines.append([*cells, _number(row["gaussians"], "{:,.0f}"), _number(row["train_seconds"], "{:.0f} s")])
    return "\n".join([f"{WHERE[group]}:", "", *(f"| {' | '.join(cells)} |" for cells in lines)])


def _with_spread(found: dict[str, Any] | None) -> str:
    return "-" if found is None else f"{found['mean']:.1f} ({found['min']:.1f} to {found['max']:.1f})"


def _with_error(found: dict[str, Any] | None) -> str:
    if found is None:
        return "-"
    error = found["standard_error"]
    return f"{found['mean']:+.2f}" + ("" if error is None else f" ± {error:.2f}")


def _number(found: dict[str, Any] | None, spelling: str) -> str:
    return "-" if found is None else spelling.format(found["mean"])
