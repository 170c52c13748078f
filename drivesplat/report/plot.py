"""The gap by method as a plot for the page."""

import io
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.report.gaps import moving_gap

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""A palette for colour-blind readers (Okabe and Ito 2008)."""
_STYLE = {"svg.fonttype": "none", "svg.hashsalt": "drivesplat", "font.family": "sans-serif", "font.size": 10}


def gap_plot(report: dict[str, Any]) -> str:
    """The gap in dB as an SVG: for each group of held-out frames with moving vehicles a dot per scene and method, and
    the mean with its interval. Empty without a gap."""
    drawn = [g for g in GROUP_PLACES if any(mean["figures"][f"{g}_gap_db"] for mean in report["means"])]
    if not drawn:
        return ""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(4.4 * len(drawn), 3.4), layout="constrained")
        axes = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
        for panel, group in zip(axes, drawn, strict=True):
            _draw(panel, report, group)
        axes[0].set_ylabel("gap: static minus moving vehicles, dB")
        drawing = io.StringIO()
        figure.savefig(drawing, format="svg", metadata={"Date": None, "Creator": None})
    text = drawing.getvalue()
    return text[text.index("<svg") :]


def _draw(axes: Axes, report: dict[str, Any], group: str) -> None:
    methods = [mean["method"] for mean in report["means"]]
    for at, mean in enumerate(report["means"]):
        color = COLORS[at % len(COLORS)]
        gaps = [moving_gap(row, group) for row in report["rows"] if row["method"] == mean["method"]]
        known = sorted(gap for gap in gaps if gap is not None)
        offsets = 0.28 * np.linspace(-1.0, 1.0, len(known)) if len(known) > 1 else np.zeros(len(known))
        axes.plot(at + offsets, known, "o", color=color, alpha=0.45, markersize=5)
        found = mean["figures"][f"{group}_gap_db"]
        if found:
            axes.plot([at - 0.36, at + 0.36], [found["mean"]] * 2, color=color, linewidth=2.5)
            if found["low"] is not None:
                axes.plot([at, at], [found["low"], found["high"]], color=color, linewidth=2.5)
    axes.axhline(0.0, color="#888888", linewidth=0.8)
    axes.set_xticks(range(len(methods)), methods)
    axes.set_xlim(-0.6, len(methods) - 0.4)
    axes.set_title(GROUP_PLACES[group], fontsize=11)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
