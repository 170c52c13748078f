"""The stage `ablation`: the contribution of each component of a method, from trainings without it."""

from pathlib import Path
from typing import Any

from drivesplat.evaluation.comparison import (
    PSNR_COLUMNS,
    PSNRS,
    compare_runs,
    format_mean,
    group_table,
    measured_groups,
    psnr_cells,
    summarize,
    values_at,
)
from drivesplat.evaluation.scene_metrics import side_by_side
from drivesplat.io import storage
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.ablation import AblationJob

COSTS = ("gaussians", "train_seconds")
_SPREAD = {"": "mean", "_min": "min", "_max": "max"}


def ablation(evals: dict[str, dict[str, Any]], job: AblationJob) -> dict[str, Any]:
    """The content of ablation.json, without provenance, from the eval.json of every method of the ablation by name.

    The first row is the complete method (`without` is null); one row follows for every variant, with the figures of its
    runs, one per seed, compared with those of the complete method. Raises ResultError if two methods were measured
    under different protocols.
    """
    measured = side_by_side(evals)
    results = measured.pop("methods")
    runs_of = {without: [results[job.method(without, s)] for s in job.seeds] for without in (None, *job.without)}
    rows = []
    for without, runs in runs_of.items():
        figures = compare_runs(runs, None if without is None else runs_of[None], PSNRS)
        costs = {name: summarize(values_at(runs, name)) for name in COSTS}
        variant = {"variant": job.variant(without), "without": without}
        rows.append({**variant, "seeds": len(runs), **figures, **costs})
    return {**measured, **job.model_dump(mode="json", include={"of", "seeds"}), "rows": rows}


def write_csv(path: str | Path, record: dict[str, Any]) -> None:
    """Writes the rows of an ablation as CSV; null figures are empty cells."""
    lines = []
    for row in record["rows"]:
        line = {"scene": record["scene"], "variant": row["variant"], "seeds": row["seeds"]}
        for group in HELD_OUT_GROUPS:
            for name in PSNRS:
                figure, difference = row[group][name] or {}, row[group]["difference"][name] or {}
                line |= {f"{group}_{name}{suffix}": figure.get(key) for suffix, key in _SPREAD.items()}
                line[f"{group}_{name}_difference"] = difference.get("mean")
                line[f"{group}_{name}_difference_standard_error"] = difference.get("standard_error")
        for name in COSTS:
            line |= {f"{name}{suffix}": (row[name] or {}).get(key) for suffix, key in _SPREAD.items()}
        lines.append(line)
    storage.write_csv(path, list(lines[0]), lines)


def markdown(record: dict[str, Any]) -> str:
    """An ablation in Markdown: a legend, and a table for each group of held-out frames with figures."""
    rows, seeds = record["rows"], ", ".join(map(str, record["seeds"]))
    legend = (
        f"`{record['of']}` on scene {record['scene']}, random seeds {seeds}. PSNR in dB: mean over the seeds (minimum "
        "to maximum).\nDifference from the complete method: mean of the paired differences ± its standard error."
    )
    header = ("without", *PSNR_COLUMNS, "Gaussians", "training")
    tables = []
    for group in measured_groups(rows, PSNRS):
        lines = [
            [
                f"`{row['without']}`" if row["without"] else "nothing",
                *psnr_cells(row, group),
                format_mean(row["gaussians"], "{:,.0f}"),
                format_mean(row["train_seconds"], "{:.0f} s"),
            ]
            for row in rows
        ]
        tables.append(group_table(group, header, lines))
    return "\n\n".join([legend, *tables])
