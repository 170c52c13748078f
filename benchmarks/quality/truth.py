"""The figures of recipes against the truth of a synthetic world: views beside the recorded path, and the removal of
the leading car."""

from collections.abc import Sequence
from typing import Any

from drivesplat.evaluation.comparison import (
    Figures,
    Run,
    format_mean,
    format_spread,
    markdown_table,
    summarize,
    values_at,
)

LATERAL: Figures = {
    "static": ("static", "psnr"),
    "moving_vehicle": ("moving_vehicle", "psnr"),
    "depth_error": ("depth", "median_relative_error"),
}
"""The figures of a view beside the recorded path."""
REMOVAL: Figures = {"removed": ("box", "psnr"), "not_removed": ("not_removed", "box", "psnr")}
"""The PSNR in the box of the leading car against the street without it: after the removal, and of the unchanged
model."""


def truth_figures(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures of a recipe's runs, one run per seed, against truth: `lateral` by offset in metres to the left, and
    `removal`. Without truth `lateral` is empty and the figures of `removal` are None."""
    offsets = sorted({offset for run in runs if run for offset in run.get("lateral") or {}}, key=float)
    return {
        "lateral": {offset: _summaries(runs, LATERAL, "lateral", offset) for offset in offsets},
        "removal": _summaries(runs, REMOVAL, "removal"),
    }


def truth_tables(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The Markdown tables of rows with `truth`; none where no row has any."""
    lateral = [
        [f"`{row['recipe']}`", _side(float(offset)), *_cells(figures)]
        for row in rows
        for offset, figures in row["truth"]["lateral"].items()
    ]
    removal = [
        [f"`{row['recipe']}`", *(format_spread(row["truth"]["removal"][name]) for name in REMOVAL)]
        for row in rows
        if row["truth"]["removal"]["removed"]
    ]
    tables = {
        "Views beside the recorded path, against the truth": (
            ["recipe", "view", "static", "moving vehicles", "depth error"], lateral,
        ),
        "The car ahead removed, in its box, against the truth": (["recipe", "PSNR", "not removed"], removal),
    }  # fmt: skip
    return [f"{title}:\n\n{markdown_table(header, lines)}" for title, (header, lines) in tables.items() if lines]


def _summaries(runs: Sequence[Run], figures: Figures, *keys: str) -> dict[str, Any]:
    return {name: summarize(values_at(runs, *keys, *below)) for name, below in figures.items()}


def _cells(figures: dict[str, Any]) -> list[str]:
    psnrs = [format_spread(figures[name]) for name in ("static", "moving_vehicle")]
    return [*psnrs, format_mean(figures["depth_error"], "{:.1%}")]


def _side(left_m: float) -> str:
    """
    >>> _side(2.0), _side(-4.0)
    ('2 m to the left', '4 m to the right')
    """
    return f"{abs(left_m):g} m to the {'left' if left_m > 0 else 'right'}"
