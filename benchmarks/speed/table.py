"""speed.json in Markdown: tables ready for the documentation, with what they must be read with."""

from typing import Any

from benchmarks.speed.compare import FIGURES
from benchmarks.speed.plan import RECIPES
from drivesplat.evaluation.comparison import WHERE, markdown_table, mean_as, measured_groups, with_error, with_spread
from drivesplat.training.clock import ITERATION, OTHER

HOW_TO_READ = (
    "Seconds of the training loop, and of the whole from parser.pkl to the files it leaves; PSNR in dB on held-out "
    "frames {where}. Means over the seeds (least to greatest). Difference from `plain`: mean of the differences seed "
    "by seed ± its standard error."
)
STAGES = (
    "Milliseconds an iteration, over {profiled} iterations that go on from the trained models of seed {seed}, not part "
    "of the runs above:"
)
BUSY = (
    "Meanwhile up to {busy_elsewhere:.1f} of the {processors} processors had other work: alone it takes less time, and "
    "ratios of such times say little."
)
MUCH = 0.2
"""So large a share of the processors with other work is told."""


def markdown(record: dict[str, Any]) -> str:
    """The content of speed.json as a page."""
    parts = [f"# Speed of `{record['method']}` on scene {record['scene']}"]
    for table in record["tables"]:
        parts += _page(table, record)
    if not record["tables"]:
        parts.append("Nothing was measured.")
    return "\n\n".join(parts) + "\n"


def _page(table: dict[str, Any], record: dict[str, Any]) -> list[str]:
    """A length: the protocol, times beside quality, further quality, and where the time goes."""
    groups = measured_groups(table["rows"], FIGURES)
    first = groups[0] if groups else "interpolation"
    parts = [f"## {table['iterations']:,} iterations", _protocol(table, record)]
    parts += [HOW_TO_READ.format(where=WHERE[first]), _times(table, record, first)]
    for group in groups[1:]:
        parts += [f"{WHERE[group].capitalize()}:", _quality(table, record, group)]
    if table["stages"]:
        told = STAGES.format(profiled=record["profiled"], seed=record["seeds"][0])
        parts += [told, _stages(table["stages"], record["method"])]
    if table["busy_elsewhere"] >= MUCH * table["processors"]:
        parts.append(BUSY.format(**table))
    return parts


def _protocol(table: dict[str, Any], record: dict[str, Any]) -> str:
    """The line without which the figures say nothing."""
    protocol = table["protocol"]
    return (
        f"Scene {record['scene']} of {table['dataset']} ({protocol['version']}), {', '.join(protocol['cameras'])} at "
        f"{protocol['width']}x{protocol['height']}, {protocol['train_images']:,} training images; at most "
        f"{table['cap_max']:,} Gaussians; {', '.join(table['devices'])}, {table['processors']} processors; SSIM of "
        f"`plain`: {table['ssim_of_plain']}; random seeds {', '.join(map(str, table['seeds']))}."
    )


def _times(table: dict[str, Any], record: dict[str, Any], group: str) -> str:
    """What each recipe costs, with the quality that it buys."""
    header = [
        *("recipe", "loop", "whole", "iterations/s", "times as fast", "Gaussians", "GPU memory"),
        *("static", "difference", "all", "difference"),
    ]
    lines = []
    for row in table["rows"]:
        fast = None if row["recipe"] == "plain" else table["times_as_fast"]["loop"]
        cells = [_name(row["recipe"], record["method"])]
        cells += [_seconds(row["loop"]), _seconds(row["whole"]), mean_as(row["iterations_per_second"], "{:.1f}")]
        cells += [_spread(fast, 2), mean_as(row["gaussians"], "{:,.0f}")]
        cells += [mean_as(row["peak_gpu_memory_gb"], "{:.1f} GB"), *_psnrs(row[group])]
        lines.append(cells)
    return markdown_table(header, lines)


def _quality(table: dict[str, Any], record: dict[str, Any], group: str) -> str:
    lines = [[_name(row["recipe"], record["method"]), *_psnrs(row[group])] for row in table["rows"]]
    return markdown_table(["recipe", "static", "difference", "all", "difference"], lines)


def _stages(stages: dict[str, Any], method: str) -> str:
    """Where the time of an iteration goes; on a GPU also how long Python was at it, where that is something else."""
    in_order = [name for recipe in reversed(RECIPES) for name in stages.get(recipe, ())]
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
    """Whether device and host were timed apart: on a CPU they are one."""
    return any(share["device_ms"] != share["host_ms"] for shares in stages.values() for share in shares.values())


def _milliseconds(shares: dict[str, Any], name: str, kind: str) -> str:
    """A stage's milliseconds, and how much of the iteration that is; a dash where there is no such stage."""
    if name not in shares:
        return "-"
    spelled, part = f"{shares[name][kind]:.2f}", shares[name][kind] / shares[ITERATION][kind]
    return spelled if name == ITERATION else f"{spelled} ({part:.0%})"


def _psnrs(group: dict[str, Any]) -> list[str]:
    return [
        cell for name in ("static", "all") for cell in (_spread(group[name]), with_error(group["difference"][name]))
    ]


def _spread(found: dict[str, Any] | None, digits: int = 1) -> str:
    """A figure with its spread, where there are several."""
    alone = found is not None and len(found["by_seed"]) == 1
    return mean_as(found, f"{{:.{digits}f}}") if alone else with_spread(found, digits)


def _seconds(found: dict[str, Any]) -> str:
    return f"{_spread(found, 0 if found['min'] >= 100 else 1)} s"


def _name(recipe: str, method: str) -> str:
    """What a recipe is called in tables: ours by its method."""
    return f"`{method if recipe == 'ours' else recipe}`"
