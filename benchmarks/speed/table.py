"""speed.json in Markdown: tables for the documentation, each with its protocol."""

from typing import Any

from benchmarks.speed.compare import FIGURES
from benchmarks.speed.curves import NEAR_DB
from benchmarks.speed.plain_ssim import FUSED
from benchmarks.speed.settings import OURS
from benchmarks.speed.stage_clock import OTHER
from drivesplat.evaluation.comparison import (
    GROUP_PLACES,
    format_difference,
    format_mean,
    format_spread,
    group_table,
    markdown_table,
    measured_groups,
)
from drivesplat.training.step import ITERATION

LEGEND = (
    "Loop: seconds of the training loop. Whole: seconds from parser.npz to the written files. PSNR in dB on held-out "
    "frames {where}. Means over the seeds (minimum to maximum). Difference from `plain`: mean of the paired "
    "differences ± its standard error."
)
STAGES = (
    "Milliseconds per iteration, over {profiled} iterations that continue from the trained models of seed {seed} after "
    "the runs above:"
)
TIME_TO_QUALITY = (
    "Time to quality: static PSNR in dB on held-out frames {where} at {visits} stops of each training, and the seconds "
    "of training until it is within {near:.1f} dB of its own best, and until it reaches the best of `plain`. The stops "
    "do not count. Between two of them PSNR is taken as linear; what the first one has counts as reached then."
)
HANDICAPPED = (
    "**The plain recipe is handicapped:** gsplat's example needs the package `fused_ssim`, which is not installed. Its "
    "SSIM in torch takes much longer."
)
BUSY = (
    "Other programs kept up to {busy_elsewhere:.1f} of the {processors} processors busy: without them training takes "
    "less time, and ratios of these times say little."
)
MIN_BUSY_SHARE = 0.2
"""The page mentions other programs if they kept at least this share of the processors busy."""


def markdown(record: dict[str, Any]) -> str:
    """The content of speed.json as a page."""
    parts = [f"# Speed of `{record['method']}` on scene {record['scene']}"]
    for table in record["tables"]:
        parts += _page(table, record)
    if not record["tables"]:
        parts.append("Nothing was measured.")
    return "\n\n".join(parts) + "\n"


def _page(table: dict[str, Any], record: dict[str, Any]) -> list[str]:
    """A training length: the protocol, times with quality, quality of further groups, and time per stage."""
    groups = measured_groups(table["rows"], FIGURES)
    first = groups[0] if groups else "interpolation"
    parts = [f"## {table['iterations']:,} iterations"]
    if table["ssim_of_plain"] != FUSED and table["rows"][0]["peak_gpu_memory_gb"] is not None:  # on a GPU
        parts.append(HANDICAPPED)
    parts.append(_protocol(table, record))
    parts += [LEGEND.format(where=GROUP_PLACES[first]), _times(table, record, first)]
    parts += [_quality(table, record, group) for group in groups[1:]]
    if any(row["time_to_quality"]["best"] for row in table["rows"]):
        title = TIME_TO_QUALITY.format(where=GROUP_PLACES[first], visits=record["visits"], near=NEAR_DB)
        parts += [title, _time_to_quality(table, record)]
    if table["stages"]:
        title = STAGES.format(profiled=record["profiled"], seed=record["seeds"][0])
        parts += [title, _stages(table["stages"], record["method"])]
    if table["busy_elsewhere"] >= MIN_BUSY_SHARE * table["processors"]:
        parts.append(BUSY.format(**table))
    return parts


def _protocol(table: dict[str, Any], record: dict[str, Any]) -> str:
    """The protocol in one line."""
    protocol = table["protocol"]
    return (
        f"Scene {record['scene']} of {table['dataset']} ({protocol['version']}), {', '.join(protocol['cameras'])} at "
        f"{protocol['width']}x{protocol['height']}, {protocol['train_images']:,} training images; at most "
        f"{table['cap_max']:,} Gaussians; {', '.join(table['devices'])}, {table['processors']} processors; SSIM of "
        f"`plain`: {table['ssim_of_plain']}; random seeds {', '.join(map(str, table['seeds']))}."
    )


def _times(table: dict[str, Any], record: dict[str, Any], group: str) -> str:
    """The costs of each recipe, with its quality."""
    header = [
        *("recipe", "loop", "whole", "iterations/s", "times as fast", "Gaussians", "GPU memory"),
        *("static", "difference", "all", "difference"),
    ]
    lines = []
    for row in table["rows"]:
        fast = row["times_as_fast"] and row["times_as_fast"]["loop"]
        cells = [_name(row["recipe"], record["method"])]
        cells += [_seconds(row["loop"]), _seconds(row["whole"]), format_mean(row["iterations_per_second"], "{:.1f}")]
        cells += [_spread(fast, 2), format_mean(row["gaussians"], "{:,.0f}")]
        cells += [format_mean(row["peak_gpu_memory_gb"], "{:.1f} GB"), *_psnrs(row[group])]
        lines.append(cells)
    return markdown_table(header, lines)


def _quality(table: dict[str, Any], record: dict[str, Any], group: str) -> str:
    lines = [[_name(row["recipe"], record["method"]), *_psnrs(row[group])] for row in table["rows"]]
    return group_table(group, ["recipe", "static", "difference", "all", "difference"], lines)


def _time_to_quality(table: dict[str, Any], record: dict[str, Any]) -> str:
    """The best quality of each recipe, and when its trainings reach it."""
    header = ["recipe", "best static", f"within {NEAR_DB:.1f} dB of it", "best of `plain`"]
    lines = []
    for row in table["rows"]:
        found = row["time_to_quality"]
        near, as_plain = (found[name] and _seconds(found[name]) for name in ("near_best", "best_of_plain"))
        lines.append([_name(row["recipe"], record["method"]), _spread(found["best"]), near or "-", as_plain or "-"])
    return markdown_table(header, lines)


def _stages(stages: dict[str, Any], method: str) -> str:
    """The time of an iteration per stage; on a GPU also the time in Python, if it differs."""
    in_order = [name for recipe in reversed(stages) for name in stages[recipe]]
    names = dict.fromkeys(name for name in in_order if name not in (OTHER, ITERATION))
    kinds = {"device_ms": "", "host_ms": ", Python"} if _apart(stages) else {"device_ms": ""}
    columns = [(recipe, kind) for recipe in stages for kind in kinds]
    header = ["stage", *(f"{_name(recipe, method)}{kinds[kind]}" for recipe, kind in columns)]
    lines = [
        [name, *(_milliseconds(stages[recipe], name, kind) for recipe, kind in columns)]
        for name in (*names, OTHER, ITERATION)
    ]
    return markdown_table(header, lines)


def _apart(stages: dict[str, Any]) -> bool:
    """Whether device and host times differ; on a CPU they are equal."""
    return any(share["device_ms"] != share["host_ms"] for shares in stages.values() for share in shares.values())


def _milliseconds(shares: dict[str, Any], name: str, kind: str) -> str:
    """A stage's milliseconds and its share of the iteration; a dash if the recipe has no such stage."""
    if name not in shares:
        return "-"
    spelled, part = f"{shares[name][kind]:.2f}", shares[name][kind] / shares[ITERATION][kind]
    return spelled if name == ITERATION else f"{spelled} ({part:.0%})"


def _psnrs(group: dict[str, Any]) -> list[str]:
    return [
        cell
        for name in ("static", "all")
        for cell in (_spread(group[name]), format_difference(group["difference"][name]))
    ]


def _spread(found: dict[str, Any] | None, digits: int = 1) -> str:
    """A figure, with its spread if there are several seeds."""
    single = found is not None and len(found["by_seed"]) == 1
    return format_mean(found, f"{{:.{digits}f}}") if single else format_spread(found, digits)


def _seconds(found: dict[str, Any]) -> str:
    return f"{_spread(found, 0 if found['min'] >= 100 else 1)} s"


def _name(recipe: str, method: str) -> str:
    """The name of a recipe in tables; ours has that of its method."""
    return f"`{method if recipe == OURS else recipe}`"
