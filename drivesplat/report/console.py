"""The report as text for the console."""

from collections.abc import Mapping
from typing import Any

from drivesplat.report.gaps import summary_sentences
from drivesplat.scene.splits import HELD_OUT_GROUPS

SHOWN = ("static", "vehicle", "moving_vehicle", "gap_db")


def console_table(report: dict[str, Any]) -> str:
    """A line per scene and method with both groups of held-out frames, means, summary sentences and missing scenes."""
    header = ["scene", "method"]
    for group in HELD_OUT_GROUPS:
        header += [f"{group[:6]}. static", "vehicle", "moving", "gap dB"]
    lines = [header, *([row["scene"], row["method"], *_cells(row)] for row in report["rows"])]
    for mean in report["means"]:
        figures = {name: found and found["mean"] for name, found in mean["figures"].items()}
        lines.append(["mean", mean["method"], *_cells(figures)])
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
    notes = [f"{item['scene']}: left out ({item['why']})" for item in report["left_out"]]
    notes += [f"{item['scene']}: {item['why']}" for item in report["missing"]]
    title = "PSNR on held-out frames" + (" (partial: see below)" if report["partial"] else "")
    return "\n".join([title, *table, *summary_sentences(report), *notes])


def _cells(figures: Mapping[str, Any]) -> list[str]:
    values = [figures[f"{group}_{name}"] for group in HELD_OUT_GROUPS for name in SHOWN]
    return ["-" if value is None else f"{value:.2f}" for value in values]
