"""quality.json in Markdown: tables for the documentation, each with its protocol."""

from collections.abc import Iterable, Sequence
from typing import Any

import yaml

from benchmarks.quality.compare import COSTS, FIGURES, MEASURING_PROTOCOL
from benchmarks.quality.truth import truth_tables
from drivesplat.evaluation.comparison import (
    GROUP_PLACES,
    PSNR_COLUMNS,
    format_mean,
    group_table,
    markdown_table,
    measured_groups,
    psnr_cells,
)
from drivesplat.scene.splits import HELD_OUT_GROUPS

LEGEND = (
    "PSNR in dB: mean over the seeds (minimum to maximum). Difference from {reference}: mean of the paired differences "
    "± its standard error."
)
OTHER_PROTOCOL = "The protocol differs from that of the first table, so the figures do not compare: {differences}."
SHARED = "Shared: during training another job ran on the same GPU or processors; without it training takes less time."
OPTIONAL = {
    "moving_human": ("moving people", 1),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "depth_error": ("depth error", None),
}
"""Columns for figures that at least one row has: their headings, and decimals (None: percent)."""


def markdown(record: dict[str, Any]) -> str:
    """The content of quality.json as a page."""
    parts = [f"# Recipes on scene {record['scene']}"]
    for number, table in enumerate(record["tables"]):
        parts += _page(table, record, first=number == 0)
    if not record["tables"]:
        parts.append("Nothing was measured.")
    if record["failed"]:
        lines = [f"- `{item['recipe']}`, seed {item['seed']}: {item['why']}" for item in record["failed"]]
        parts += ["## What failed", "\n".join(lines)]
    lines = [f"- `{name}`: {_settings(recipe)}" for name, recipe in record["recipes"].items()]
    common = [f"All: {_settings({'base': record['base'], 'config': record['config']})}."]
    parts += ["## The recipes", "\n".join(lines), *(common if record["base"] or record["config"] else [])]
    return "\n\n".join(parts) + "\n"


def _page(table: dict[str, Any], record: dict[str, Any], first: bool) -> list[str]:
    """A table's protocol, a table of figures for each group of held-out frames, tables against the truth of a synthetic
    world, and one of costs."""
    rows, parts = table["rows"], []
    if not first:
        reference = record["tables"][0]["protocol"]
        differing = [key for key in MEASURING_PROTOCOL if table["protocol"][key] != reference[key]]
        differences = "; ".join(
            f"{key} {_yaml(table['protocol'][key])}, there {_yaml(reference[key])}" for key in differing
        )
        parts += ["## Other protocol", OTHER_PROTOCOL.format(differences=differences)]
    parts += [_protocol(table, record), LEGEND.format(reference=f"`{table['reference']}`")]
    failed = _failed(record) if first else []
    parts += [_figures(rows, group, failed) for group in measured_groups(rows, FIGURES)]
    parts += truth_tables(rows)
    parts += ["Training data and costs:", _costs(rows)]
    return [*parts, SHARED] if any(row["shared"] for row in rows) else parts


def _protocol(table: dict[str, Any], record: dict[str, Any]) -> str:
    """The protocol in one line."""
    protocol, rows = table["protocol"], table["rows"]
    held_out = [
        f"{_numbers(frames)} {GROUP_PLACES[group]}"
        for group in HELD_OUT_GROUPS
        if (frames := protocol["held_out_frames"][group])
    ]
    poses = _each(row["trained_on"]["poses"] for row in rows)
    iterations = _each(f"{row['train_iterations']:,}" for row in rows)
    devices = _each(device for row in rows for device in row["devices"])
    return (
        f"Scene {record['scene']} of {table['dataset']} ({protocol['version']}), {protocol['eval_camera']} at "
        f"{protocol['width']}x{protocol['height']}; held out: key frames {' and '.join(held_out) or 'none'}; regions "
        f"from {protocol['regions']}; poses: {poses}; {iterations} iterations; {devices}; random seeds "
        f"{', '.join(map(str, record['seeds']))}."
    )


def _figures(rows: Sequence[dict[str, Any]], group: str, failed: list[list[str]]) -> str:
    """The figures of a group of held-out frames, and the rows of recipes without any."""
    optional = [name for name in OPTIONAL if any(row[group][name] for row in rows)]
    header = ["recipe", *PSNR_COLUMNS, *(OPTIONAL[name][0] for name in optional)]
    lines = [
        [f"`{row['recipe']}`", *psnr_cells(row, group), *(_optional(row[group][o], OPTIONAL[o][1]) for o in optional)]
        for row in rows
    ]
    return group_table(group, header, [*lines, *(cells + [""] * (len(header) - len(cells)) for cells in failed)])


def _optional(found: dict[str, Any] | None, digits: int | None) -> str:
    return format_mean(found, "{:.1%}" if digits is None else f"{{:.{digits}f}}")


def _costs(rows: Sequence[dict[str, Any]]) -> str:
    header = [
        *("recipe", "seeds", "training images", "sweeps", "poses", "iterations"),
        *("Gaussians", "training", "GPU memory", "device"),
    ]
    lines = []
    for row in rows:
        on, (gaussians, seconds, memory) = row["trained_on"], (row[name] for name in COSTS)
        cells = [f"`{row['recipe']}`", ", ".join(map(str, row["seeds"])), f"{on['train_images']:,}"]
        cells += ["yes" if on["sweeps"] else "no", on["poses"], f"{row['train_iterations']:,}"]
        cells += [
            format_mean(gaussians, "{:,.0f}"),
            format_mean(seconds, "{:.0f} s") + (", shared" if row["shared"] else ""),
        ]
        lines.append([*cells, format_mean(memory, "{:.1f} GB"), _each(row["devices"])])
    return markdown_table(header, lines)


def _failed(record: dict[str, Any]) -> list[list[str]]:
    """The first cells of rows of recipes without any result: name and reason."""
    measured = {row["recipe"] for table in record["tables"] for row in table["rows"]}
    reasons: dict[str, str] = {}
    for item in record["failed"]:
        if item["recipe"] not in measured:
            reasons.setdefault(item["recipe"], item["why"])
    return [[f"`{name}`", f"failed: {reason}".replace("|", "\\|")] for name, reason in reasons.items()]


def _settings(tree: dict[str, Any]) -> str:
    """The settings of a recipe in one line."""
    given = {key: value for key, value in tree.items() if value}
    return ", ".join(f"{key} {_yaml(value)}" for key, value in given.items()) or "the settings of the config"


def _yaml(value: Any) -> str:
    """A value in YAML, on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return f"`{text.strip().removesuffix('...').strip()}`"


def _each(values: Iterable[str]) -> str:
    """The distinct values."""
    return ", ".join(dict.fromkeys(values))


def _numbers(numbers: Sequence[int]) -> str:
    """Rising numbers, with three or more consecutive ones as a range: 4, 12, 35 to 38."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    spelled = ([str(n) for n in run] if len(run) < 3 else [f"{run[0]} to {run[-1]}"] for run in runs)
    return ", ".join(text for texts in spelled for text in texts)
