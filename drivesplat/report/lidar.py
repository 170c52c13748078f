"""The LiDAR scans of the measured scenes, rendered by methods and made by the baselines: rows, means, and tables."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.evaluation.scan_metrics import FIGURES, SCAN_REGIONS
from drivesplat.report.statistics import mean_over_scenes
from drivesplat.scene.splits import HELD_OUT_GROUPS

COUNTS = ("rays", "returns")
LIDAR_COLUMNS = tuple(
    f"{group}_lidar_{region}_{name}"
    for group in HELD_OUT_GROUPS
    for region in SCAN_REGIONS
    for name in (*FIGURES, *COUNTS)
)
"""The figures of a row: of a held-out group, a region, and a name in metrics.json."""
BASELINE_NAMES = {"nearest_scan": "nearest scan, moved", "neighbouring_scans": "two scans, fused"}
"""The baselines in words, by their names in metrics.json."""
REGION_NAMES = {"all": "all rays", "static": "static", "moving_vehicle": "moving vehicles"}
TABLE_FIGURES = (
    {"key": "range_error_median_m", "title": "range, cm ↓", "form": "{:.1f}", "kind": "first", "scale": 100},
    {"key": "intensity_rmse", "title": "intensity ↓", "form": "{:.3f}", "kind": "", "scale": 1},
    {"key": "drop_accuracy", "title": "drops, % ↑", "form": "{:.1f}", "kind": "", "scale": 100},
    {"key": "chamfer_m", "title": "Chamfer, m ↓", "form": "{:.2f}", "kind": "", "scale": 1},
    {"key": "rays", "title": "rays", "form": "{:,.0f}", "kind": "", "scale": 1},
)
"""The columns of a group of held-out scans: key of the figure, title, format, CSS class, and factor of its unit."""


def lidar_rows(record: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a metrics.json: of each method that renders LiDAR, and of the baselines (`baseline`). `reasons` says
    by group and region why figures are null. Raises KeyError, TypeError, or ValueError for a figure that is no finite
    number."""
    methods = [
        (name, False, {group: result[group]["lidar"] for group in HELD_OUT_GROUPS})
        for name, result in record["methods"].items()
        if all("lidar" in (result.get(group) or {}) for group in HELD_OUT_GROUPS)
    ]
    baselines = [(name, True, groups) for name, groups in record.get("lidar_baselines", {}).items()] if methods else []
    place = {"scene": record["scene"], "dataset": record["dataset"]}
    return [
        {**place, "method": name, "baseline": baseline, **_figures(name, groups)}
        for name, baseline, groups in (*methods, *baselines)
    ]


def _figures(method: str, groups: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = dict.fromkeys(LIDAR_COLUMNS)
    reasons: dict[str, dict[str, str]] = {group: {} for group in HELD_OUT_GROUPS}
    for group in HELD_OUT_GROUPS:
        for region in SCAN_REGIONS:
            own = groups[group][region]
            for name in (*FIGURES, *COUNTS):
                value = own[name]
                if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
                    raise ValueError(f"lidar {group} {region} {name} of {method} is {value!r}, not a number")
                found[f"{group}_lidar_{region}_{name}"] = value
            if "unavailable" in own:
                reasons[group][region] = str(own["unavailable"])
    return {**found, "reasons": reasons}


def lidar_report(rows: Sequence[dict[str, Any]], random_seed: int) -> dict[str, Any]:
    """The entry `lidar` of gap_report.json: `rows`, and the `means` of every figure over scenes by method or baseline,
    in which `rays` and `returns` are sums; null figures are ignored."""
    methods: dict[str, list[dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["baseline"]):
        methods.setdefault(row["method"], []).append(row)
    counts = tuple(f"_{name}" for name in COUNTS)
    means = [
        {
            "method": method,
            "baseline": own[0]["baseline"],
            "figures": {
                column: sum(values) if column.endswith(counts) else mean_over_scenes(values, random_seed)
                for column, values in ((column, [row[column] for row in own]) for column in LIDAR_COLUMNS)
            },
        }
        for method, own in methods.items()
    ]
    return {"rows": list(rows), "means": means}


def page_table(lidar: dict[str, Any]) -> dict[str, Any]:
    """The table of the page: `groups` of columns with their numbers of columns, the `columns` of each group, `rows` by
    scene, region and method, `means` by region and method where there are several scenes, and `reasons`, a sentence for
    each dash."""
    columns = [
        {**column, "key": f"{group}_{column['key']}", "of": (group, column["key"])}
        for group in HELD_OUT_GROUPS
        for column in TABLE_FIGURES
    ]
    rows, means = [], []
    for scene in dict.fromkeys(row["scene"] for row in lidar["rows"]):
        own = [row for row in lidar["rows"] if row["scene"] == scene]
        rows += [_shown({**row, "row": row}, region, columns) for region in SCAN_REGIONS for row in own]
    for region in SCAN_REGIONS if len({row["scene"] for row in lidar["rows"]}) > 1 else ():
        means += [_shown({**mean, "row": mean["figures"]}, region, columns) for mean in lidar["means"]]
    # the reasons of null figures; each names the rows that it holds for unless these are all
    found: dict[tuple[str, str, str, str], list[str]] = {}
    for row in lidar["rows"]:
        for group, regions in row["reasons"].items():
            for region, why in regions.items():
                found.setdefault((row["scene"], region, group, why), []).append(row["method"])
    counts = Counter(row["scene"] for row in lidar["rows"])
    return {
        "groups": [(place, len(TABLE_FIGURES)) for place in GROUP_PLACES.values()],
        "columns": columns,
        "rows": rows,
        "means": means,
        "reasons": [
            f"{scene}, {REGION_NAMES[region]}, {GROUP_PLACES[group]}"
            f"{'' if len(methods) == counts[scene] else ' (' + ', '.join(methods) + ')'}: {why}"
            for (scene, region, group, why), methods in found.items()
        ],
    }


def _shown(item: dict[str, Any], region: str, columns: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """A row or a mean in one region: names, and its figures by the keys of `columns` in their units."""
    figures = {}
    for column in columns:
        group, name = column["of"]
        figures[column["key"]] = _in_units(item["row"][f"{group}_lidar_{region}_{name}"], column["scale"])
    return {
        "scene": item.get("scene"),
        "region": REGION_NAMES[region],
        "method": BASELINE_NAMES.get(item["method"], item["method"]) if item["baseline"] else item["method"],
        "baseline": item["baseline"],
        "figures": figures,
    }


def _in_units(value: Any, scale: int | float) -> Any:
    """A figure, or a mean with its interval, in the unit of its column."""
    if isinstance(value, dict):
        scaled = {name: _in_units(value[name], scale) for name in ("mean", "low", "high")}
        return {**value, **scaled}
    return None if value is None else value * scale
