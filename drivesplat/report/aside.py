"""Views from beside the recorded path in the report: rows, means, and the table of the page."""

import math
from collections.abc import Sequence
from typing import Any

from drivesplat.evaluation.comparison import values_at
from drivesplat.evaluation.views_aside import LATERAL, VIEW_FIGURES, place_of_view, views_aside
from drivesplat.report.statistics import mean_over_scenes

TABLE_FIGURES = (
    {"key": "static", "title": "static ↑", "form": "{:.1f}", "kind": "first"},
    {"key": "moving_vehicle", "title": "moving ↑", "form": "{:.1f}", "kind": ""},
    {"key": "road", "title": "road ↑", "form": "{:.1f}", "kind": ""},
    {"key": "markings", "title": "markings ↑", "form": "{:.1f}", "kind": ""},
    {"key": "depth_error", "title": "depth error ↓", "form": "{:.1%}", "kind": ""},
)
"""The columns of the table: key of the figure, title, format and CSS class."""


def aside_rows(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a metrics.json, one for each view from beside the path and each method. Raises TypeError, or
    ValueError for a figure that is no finite number."""
    methods, place = record["methods"], {"scene": record["scene"], "dataset": record["dataset"]}
    return [
        {**place, "kind": kind, "view": key, "method": name, **_figures(name, result, kind, key)}
        for kind, key in views_aside(list(methods.values()))
        for name, result in methods.items()
        if key in (result.get(kind) or {})
    ]


def _figures(method: str, result: dict[str, Any], kind: str, key: str) -> dict[str, float | None]:
    found = {name: values_at([result], kind, key, *keys)[0] for name, keys in VIEW_FIGURES.items()}
    for name, value in found.items():
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
            raise ValueError(f"{kind} {key} {name} of {method} is {value!r}, not a number")
    return found


def aside_report(rows: Sequence[dict[str, Any]], random_seed: int) -> dict[str, Any]:
    """The entry `aside` of gap_report.json: `rows`, and the `means` of every figure over scenes by view and method;
    null figures are ignored."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["kind"], row["view"], row["method"]), []).append(row)
    means = [
        {
            **dict(zip(("kind", "view", "method"), group, strict=True)),
            "figures": {name: mean_over_scenes([row[name] for row in own], random_seed) for name in VIEW_FIGURES},
        }
        for group, own in groups.items()
    ]
    return {"rows": list(rows), "means": means}


def aside_table(aside: dict[str, Any]) -> dict[str, Any]:
    """The table of the page: its `columns`, `rows` by scene, view and method, and `means` by view and method where
    there are several scenes."""
    several = len({row["scene"] for row in aside["rows"]}) > 1
    return {
        "columns": TABLE_FIGURES,
        "rows": [{**row, "place": _place(row)} for row in aside["rows"]],
        "means": [{**mean, "place": _place(mean)} for mean in aside["means"]] if several else [],
    }


def _place(row: dict[str, Any]) -> str:
    place = place_of_view((row["kind"], row["view"]))
    return place if row["kind"] == LATERAL else f"{place}, left out"


def aside_columns(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str, str], dict[str, Any]]:
    """The figures of rows as columns of a table with one line per scene, dataset and method: `lateral_2.0_static`."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in rows:
        line = found.setdefault((row["scene"], row["dataset"], row["method"]), {})
        line |= {f"{row['kind']}_{row['view']}_{name}": row[name] for name in VIEW_FIGURES}
    return found
