"""Comparison of methods trained with several random seeds: means with their spread, paired differences with their
standard error, and Markdown tables of both.

A run is the `result` of an eval.json, or None where a training has none. Null figures are left out of every mean.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from statistics import mean, stdev
from typing import Any

from drivesplat.scene.splits import HELD_OUT_GROUPS

Run = dict[str, Any] | None
Figures = Mapping[str, tuple[str, ...]]
"""The figures to compare in a group of held-out frames, each with its keys below the group."""
PSNRS: Figures = {"static": ("static", "psnr"), "moving_vehicle": ("moving_vehicle", "psnr"), "gap_db": ("gap_db",)}
"""The PSNR of two regions, and the gap between them, in dB."""
PSNR_COLUMNS = ("static", "difference", "moving vehicles", "difference", "gap")
"""The headings of `psnr_cells`."""
GROUP_PLACES = {"interpolation": "between training frames", "extrapolation": "beyond the last training frame"}
"""Where the frames of a held-out group lie, for tables and sentences."""


def summarize(values: Sequence[int | float | None]) -> dict[str, Any] | None:
    """`mean`, `min` and `max` over the values that are not null, and all values as `by_seed`; None if all are null.

    >>> summarize([2.0, None, 4.0])
    {'mean': 3.0, 'min': 2.0, 'max': 4.0, 'by_seed': [2.0, None, 4.0]}
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"mean": mean(known), "min": min(known), "max": max(known), "by_seed": list(values)}


def paired_difference(values: Sequence[float | None], reference: Sequence[float | None]) -> dict[str, Any] | None:
    """The `mean` of value minus reference, paired by seed, and its `standard_error` (None for a single pair); None if
    no seed has both."""
    differences = [None if a is None or b is None else a - b for a, b in zip(values, reference, strict=True)]
    known = [value for value in differences if value is not None]
    if not known:
        return None
    error = stdev(known) / sqrt(len(known)) if len(known) > 1 else None
    return {"mean": mean(known), "standard_error": error, "by_seed": differences}


def compare_runs(runs: Sequence[Run], reference: Sequence[Run] | None, figures: Figures) -> dict[str, Any]:
    """The figures of a method's runs, one run per seed, for each group of held-out frames. `difference` in each group
    holds the paired differences from the reference's runs (None: these are the reference)."""
    row: dict[str, Any] = {}
    for group in HELD_OUT_GROUPS:
        found = {name: values_at(runs, group, *keys) for name, keys in figures.items()}
        differences = {
            name: None if reference is None else paired_difference(found[name], values_at(reference, group, *keys))
            for name, keys in figures.items()
        }
        row[group] = {**{name: summarize(values) for name, values in found.items()}, "difference": differences}
    return row


def values_at(runs: Sequence[Run], *keys: str) -> list[Any]:
    """The value below `keys` in every run; None where it, or a record above it, is null or missing."""
    found: list[Any] = []
    for value in runs:
        for key in keys:
            value = None if value is None else value.get(key)
        found.append(value)
    return found


def measured_groups(rows: Sequence[dict[str, Any]], figures: Figures) -> list[str]:
    """The groups of held-out frames in which any row has a figure."""
    return [group for group in HELD_OUT_GROUPS if any(row[group][name] for row in rows for name in figures)]


def psnr_cells(row: dict[str, Any], group: str) -> list[str]:
    """The cells of a row for the columns `PSNR_COLUMNS`: spreads, and differences from the reference."""
    figures, cells = row[group], []
    for name in ("static", "moving_vehicle"):
        cells += [format_spread(figures[name]), format_difference(figures["difference"][name])]
    return [*cells, format_mean(figures["gap_db"], "{:.1f}")]


def format_spread(figure: dict[str, Any] | None, digits: int = 1) -> str:
    """Mean, minimum and maximum; a dash for null."""
    if figure is None:
        return "-"
    return f"{figure['mean']:.{digits}f} ({figure['min']:.{digits}f} to {figure['max']:.{digits}f})"


def format_difference(difference: dict[str, Any] | None) -> str:
    """A signed mean with its standard error, if there is one; a dash for null."""
    if difference is None:
        return "-"
    error = difference["standard_error"]
    return f"{difference['mean']:+.2f}" + ("" if error is None else f" ± {error:.2f}")


def format_mean(figure: dict[str, Any] | None, template: str) -> str:
    """The mean of a figure through a template of `str.format`; a dash for null."""
    return "-" if figure is None else template.format(figure["mean"])


def markdown_table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *lines))


def group_table(group: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """The Markdown table of a group of held-out frames, below a line that names the group."""
    return f"{GROUP_PLACES[group].capitalize()}:\n\n{markdown_table(header, lines)}"
