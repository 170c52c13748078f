"""The stage `ablation`: what each thing in a method is worth, from trainings of the method without it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drivesplat.evaluation.comparison import (
    PSNRS,
    WHERE,
    compared,
    figure,
    markdown_table,
    mean_as,
    measured_groups,
    values_at,
    with_error,
    with_spread,
)
from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.io import storage
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.ablation import AblationJob

COSTS = ("gaussians", "train_seconds")


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


def _row(runs: list[dict[str, Any]], whole: list[dict[str, Any]] | None) -> dict[str, Any]:
    """The figures of a variant's runs, one a seed, beside those of the whole method (None: these are the whole's)."""
    costs = {name: figure(values_at(runs, name)) for name in COSTS}
    return {"seeds": len(runs), **compared(runs, whole, PSNRS), **costs}


def write_csv(path: str | Path, record: dict[str, Any]) -> None:
    """The rows of an ablation as a table; empty cells where a figure is null."""
    lines = [dict(_cells(row, record)) for row in record["rows"]]
    storage.write_csv(path, list(lines[0]), lines)


def _cells(row: dict[str, Any], record: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The columns of a row and what stands there."""
    yield from (("scene", record["scene"]), ("variant", row["variant"]), ("seeds", row["seeds"]))
    for group in HELD_OUT_GROUPS:
        for name in PSNRS:
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
    return "\n\n".join([head, *(_table(rows, group) for group in measured_groups(rows, PSNRS))])


def _table(rows: list[dict[str, Any]], group: str) -> str:
    """The table of a group of held-out frames."""
    header = ["without", "static", "difference", "moving vehicles", "difference", "gap", "Gaussians", "training"]
    lines = []
    for row in rows:
        cells = [f"`{row['without']}`" if row["without"] else "nothing"]
        for name in ("static", "moving_vehicle"):
            cells += [with_spread(row[group][name]), with_error(row[group]["difference"][name])]
        cells += [mean_as(row[group]["gap_db"], "{:.1f}")]
        lines.append([*cells, mean_as(row["gaussians"], "{:,.0f}"), mean_as(row["train_seconds"], "{:.0f} s")])
    return f"{WHERE[group].capitalize()}:\n\n{markdown_table(header, lines)}"
