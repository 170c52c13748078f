"""quality.json in Markdown: tables ready for the documentation, with what they must be read with."""

from collections.abc import Iterable, Sequence
from typing import Any

import yaml

from benchmarks.quality.compare import COSTS, FIGURES, MEASURED_BY
from drivesplat.evaluation.comparison import WHERE, markdown_table, mean_as, measured_groups, with_error, with_spread
from drivesplat.scene.splits import HELD_OUT_GROUPS

HOW_TO_READ = (
    "PSNR in dB: mean over the seeds (least to greatest). Difference from {reference}: mean of the differences seed by "
    "seed ± its standard error."
)
APART = "Measured otherwise than the first table, its figures do not compare with that one's: {differences}."
SHARED = "Shared: while it was trained another job ran on the same card or processors; alone it takes less time."
OPTIONAL = {"ssim": ("SSIM", 3), "lpips": ("LPIPS", 3), "depth_error": ("depth error", None)}
"""Columns that are there where any row has the figure: their headings, and decimals (None: per cent)."""


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
    told = [f"- `{name}`: {_told(recipe)}" for name, recipe in record["recipes"].items()]
    common = [f"All: {_told({'base': record['base'], 'config': record['config']})}."]
    parts += ["## The recipes", "\n".join(told), *(common if record["base"] or record["config"] else [])]
    return "\n\n".join(parts) + "\n"


def _page(table: dict[str, Any], record: dict[str, Any], first: bool) -> list[str]:
    """A table's protocol, a table of figures for each group of held-out frames, and one of costs."""
    rows, parts = table["rows"], []
    if not first:
        reference = record["tables"][0]["protocol"]
        unlike = [key for key in MEASURED_BY if table["protocol"][key] != reference[key]]
        differences = "; ".join(
            f"{key} {_spelled(table['protocol'][key])}, there {_spelled(reference[key])}" for key in unlike
        )
        parts += ["## Measured otherwise", APART.format(differences=differences)]
    parts += [_protocol(table, record), HOW_TO_READ.format(reference=f"`{table['reference']}`")]
    failed = _failed(record) if first else []
    for group in measured_groups(rows, FIGURES):
        parts += [f"{WHERE[group].capitalize()}:", _figures(rows, group, failed)]
    parts += ["What they are trained on, and what they cost:", _costs(rows)]
    return [*parts, SHARED] if any(row["shared"] for row in rows) else parts


def _protocol(table: dict[str, Any], record: dict[str, Any]) -> str:
    """The line without which the figures say nothing."""
    protocol, rows = table["protocol"], table["rows"]
    held_out = [
        f"{_numbers(frames)} {WHERE[group]}"
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
    """The figures of a group of held-out frames, and the rows of recipes that have none."""
    optional = [name for name in OPTIONAL if any(row[group][name] for row in rows)]
    header = [
        "recipe",
        "static",
        "difference",
        "moving vehicles",
        "difference",
        "gap",
        *(OPTIONAL[o][0] for o in optional),
    ]
    lines = []
    for row in rows:
        cells = [f"`{row['recipe']}`"]
        for name in ("static", "moving_vehicle"):
            cells += [with_spread(row[group][name]), with_error(row[group]["difference"][name])]
        cells += [mean_as(row[group]["gap_db"], "{:.1f}")]
        lines.append([*cells, *(_optional(row[group][name], OPTIONAL[name][1]) for name in optional)])
    return markdown_table(header, [*lines, *(cells + [""] * (len(header) - len(cells)) for cells in failed)])


def _optional(found: dict[str, Any] | None, digits: int | None) -> str:
    return mean_as(found, "{:.1%}" if digits is None else f"{{:.{digits}f}}")


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
        cells += [mean_as(gaussians, "{:,.0f}"), mean_as(seconds, "{:.0f} s") + (", shared" if row["shared"] else "")]
        lines.append([*cells, mean_as(memory, "{:.1f} GB"), _each(row["devices"])])
    return markdown_table(header, lines)


def _failed(record: dict[str, Any]) -> list[list[str]]:
    """The first cells of rows of recipes without any result: their names, and why."""
    measured = {row["recipe"] for table in record["tables"] for row in table["rows"]}
    whys: dict[str, str] = {}
    for item in record["failed"]:
        if item["recipe"] not in measured:
            whys.setdefault(item["recipe"], item["why"])
    return [[f"`{name}`", f"failed: {why}".replace("|", "\\|")] for name, why in whys.items()]


def _told(tree: dict[str, Any]) -> str:
    """What a recipe sets, in a line."""
    there = {key: value for key, value in tree.items() if value}
    return ", ".join(f"{key} {_spelled(value)}" for key, value in there.items()) or "the settings of the config"


def _spelled(value: Any) -> str:
    """A value as a recipe file or a config file holds it."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return f"`{text.strip().removesuffix('...').strip()}`"


def _each(values: Iterable[str]) -> str:
    """Every value once."""
    return ", ".join(dict.fromkeys(values))


def _numbers(numbers: Sequence[int]) -> str:
    """Numbers in rising order, runs of three and more shortened: 4, 12, 35 to 38."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    spelled = ([str(n) for n in run] if len(run) < 3 else [f"{run[0]} to {run[-1]}"] for run in runs)
    return ", ".join(text for texts in spelled for text in texts)
