"""Methods that were trained with several random seeds, compared: figures with their spread, differences with their
standard error, and how both are spelled in tables.

A run is the `result` of an eval.json, None where there is none. Figures that are null count in no mean.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from statistics import mean, stdev
from typing import Any

from drivesplat.scene.splits import HELD_OUT_GROUPS

Run = dict[str, Any] | None
Figures = Mapping[str, tuple[str, ...]]
"""What is compared in a group of held-out frames, and the keys that lead to it from the group."""
PSNRS: Figures = {"static": ("static", "psnr"), "moving_vehicle": ("moving_vehicle", "psnr"), "gap_db": ("gap_db",)}
"""The PSNR of two regions, and the gap; all in dB."""
WHERE = {"interpolation": "between training frames", "extrapolation": "beyond the last training frame"}


def figure(values: Sequence[int | float | None]) -> dict[str, Any] | None:
    """Mean and spread (`min` to `max`) of a figure over the seeds in whose results it is not null; None where it is in
    all of them. `by_seed` are the values themselves."""
    there = [value for value in values if value is not None]
    if not there:
        return None
    return {"mean": mean(there), "min": min(there), "max": max(there), "by_seed": list(values)}


def difference(values: Sequence[float | None], reference: Sequence[float | None]) -> dict[str, Any] | None:
    """By how much a figure is above the reference's: the `mean` of the differences between trainings with one seed, and
    its `standard_error` (None for a single seed); None where no seed has both."""
    differences = [None if a is None or b is None else a - b for a, b in zip(values, reference, strict=True)]
    there = [value for value in differences if value is not None]
    if not there:
        return None
    error = stdev(there) / sqrt(len(there)) if len(there) > 1 else None
    return {"mean": mean(there), "standard_error": error, "by_seed": differences}


def compared(runs: Sequence[Run], reference: Sequence[Run] | None, figures: Figures) -> dict[str, Any]:
    """Per group of held-out frames the figures of runs, one a seed, and under `difference` by how much they are above
    those of the reference's runs (None: these are the reference)."""
    row: dict[str, Any] = {}
    for group in HELD_OUT_GROUPS:
        found = {name: values_at(runs, group, *keys) for name, keys in figures.items()}
        beside = {
            name: None if reference is None else difference(found[name], values_at(reference, group, *keys))
            for name, keys in figures.items()
        }
        row[group] = {**{name: figure(values) for name, values in found.items()}, "difference": beside}
    return row


def values_at(runs: Sequence[Run], *keys: str) -> list[Any]:
    """What `keys` lead to in every run; None where it is null or missing, or what it stands in is."""
    return [_value_at(run, keys) for run in runs]


def _value_at(record: Any, keys: Sequence[str]) -> Any:
    for key in keys:
        if record is None:
            return None
        record = record.get(key)
    return record


def measured_groups(rows: Sequence[dict[str, Any]], figures: Figures) -> list[str]:
    """The groups of held-out frames in which any of the rows has a figure."""
    return [group for group in HELD_OUT_GROUPS if any(row[group][name] for row in rows for name in figures)]


def with_spread(found: dict[str, Any] | None, digits: int = 1) -> str:
    """A figure as a table holds it: its mean, least and greatest; a dash where it is null."""
    if found is None:
        return "-"
    return f"{found['mean']:.{digits}f} ({found['min']:.{digits}f} to {found['max']:.{digits}f})"


def with_error(found: dict[str, Any] | None, digits: int = 2) -> str:
    """A difference as a table holds it: with its sign, and its standard error where there is one."""
    if found is None:
        return "-"
    error = found["standard_error"]
    return f"{found['mean']:+.{digits}f}" + ("" if error is None else f" ± {error:.{digits}f}")


def mean_as(found: dict[str, Any] | None, spelling: str) -> str:
    """The mean of a figure in a spelling of `str.format`; a dash where the figure is null."""
    return "-" if found is None else spelling.format(found["mean"])


def markdown_table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *lines))
