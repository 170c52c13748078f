"""The figures of recipes in views beside the recorded path, and of the removal of the leading car."""

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
from drivesplat.evaluation.views_aside import LATERAL, VIEW_FIGURES, place_of_view, views_aside
from drivesplat.scene.splits import SIDE_CAMERA

REMOVAL: Figures = {"removed": ("box", "psnr"), "not_removed": ("not_removed", "box", "psnr")}
"""The PSNR in the box of the leading car against the street without it: after the removal, and of the unchanged
model."""
TITLES = {
    LATERAL: "Views beside the recorded path, against the truth",
    SIDE_CAMERA: "Cameras that training left out, at the times of training images",
}


def truth_figures(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures of a recipe's runs, one run per seed: `lateral`, against truth, by offset in metres to the left;
    `side_camera` by camera; and `removal`. Without such views the first two are empty, and without truth the figures of
    `removal` are None."""
    found: dict[str, Any] = {LATERAL: {}, SIDE_CAMERA: {}, "removal": _summaries(runs, REMOVAL, "removal")}
    for kind, key in views_aside(runs):
        found[kind][key] = _summaries(runs, VIEW_FIGURES, kind, key)
    return found


def truth_tables(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The Markdown tables of rows with `truth`; none where no row has any."""
    header = ["recipe", "view", "static", "moving vehicles", "depth error"]
    tables = [(title, header, _views(rows, kind)) for kind, title in TITLES.items()]
    removal = [
        [f"`{row['recipe']}`", *(format_spread(row["truth"]["removal"][name]) for name in REMOVAL)]
        for row in rows
        if row["truth"]["removal"]["removed"]
    ]
    tables.append(("The car ahead removed, in its box, against the truth", ["recipe", "PSNR", "not removed"], removal))
    return [f"{title}:\n\n{markdown_table(header, lines)}" for title, header, lines in tables if lines]


def _views(rows: Sequence[dict[str, Any]], kind: str) -> list[list[str]]:
    return [
        [f"`{row['recipe']}`", place_of_view((kind, key)), *_cells(figures)]
        for row in rows
        for key, figures in row["truth"][kind].items()
    ]


def _summaries(runs: Sequence[Run], figures: Figures, *keys: str) -> dict[str, Any]:
    return {name: summarize(values_at(runs, *keys, *below)) for name, below in figures.items()}


def _cells(figures: dict[str, Any]) -> list[str]:
    psnrs = [format_spread(figures[name]) for name in ("static", "moving_vehicle")]
    return [*psnrs, format_mean(figures["depth_error"], "{:.1%}")]
