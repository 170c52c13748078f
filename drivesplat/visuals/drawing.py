"""Figures of the ghost panel and of a removal."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivesplat.evaluation.published_fixes import GHOSTS_DOCUMENT, PUBLISHED_FIXES
from drivesplat.visuals.beside_truth import MAX_ERROR
from drivesplat.visuals.figures import draw_outline, image_grid, show
from drivesplat.visuals.ghost_panel import GhostPanel
from drivesplat.visuals.removal import RemovalPair

MIN_CHANGED, MAX_HOLES = 0.5, 0.05
"""Share of the pixels of a box from which the vehicle in it counts as removed, and up to which there are no holes."""
PATH_COLOR = "#1d6fd1"
_FIXES = "\n".join(
    [f"Published fixes of ghosts ({GHOSTS_DOCUMENT}):", *(f"{fix.method}: {fix.adds}" for fix in PUBLISHED_FIXES)]
)
_FIXES_HEIGHT = 1.4
"""Inches."""


def draw_panel(panel: GhostPanel, record: dict[str, Any], method: str) -> Figure:
    """Ground truth and rendering above absolute error and ghosts."""
    title = f"Scene {record['scene']} · {method} · key frame {record['key_frame']}"
    subject, ghosts = record["subject"], record["ghosts"]
    if subject is None:
        title += f"\n{record['why_null']}"
    else:
        split = "training image" if subject["split"] == "train" else f"held out: {subject['split']}"
        title += (
            f" ({split})\n{subject['category']}, {subject['speed_m_s']:.1f} m/s, {subject['distance_m']:.0f} m away"
        )
    if ghosts is None:
        about = "Ghosts: none, no moving vehicle"
    elif not ghosts["gaussians"]:
        about = "Ghosts: none along the vehicle's path (blue)"
    else:
        amplified = f", amplified {ghosts['drawn_times']:.1f}x" if ghosts["drawn_times"] > 1.0 else ""
        count = f"{ghosts['gaussians']:,}, mean opacity {ghosts['opacity_mean']:.2f}"
        about = f"Ghosts (red{amplified}) along its path (blue): {count}"
    shape = panel.truth.shape
    figure, axes = image_grid(shape, rows=2, columns=2, title=title)
    quality = f"Rendering: vehicle {_decibels(record['vehicle'])}, static {_decibels(record['static'])}"
    show(axes[0], panel.truth, "Ground truth")
    show(axes[1], panel.render, quality)
    _show_error(axes[2], panel.render, panel.truth, "Absolute error, mean over the channels")
    show(axes[3], panel.ghosts, about)
    if len(panel.path) > 1:  # with gaps outside of the image
        inside = ((panel.path >= 0) & (panel.path <= [shape[1], shape[0]])).all(axis=1)
        line = np.where(inside[:, None], panel.path - 0.5, np.nan)
        axes[3].plot(*line.T, color=PATH_COLOR, linewidth=2.0, alpha=0.9)
    for axis in axes if len(panel.outline) else ():
        draw_outline(axis, panel.outline)
    figure.set_figheight(figure.get_figheight() + _FIXES_HEIGHT)
    figure.supxlabel(_FIXES, x=0.01, ha="left", fontsize=12, linespacing=1.4)
    return figure


def draw_removal(pair: RemovalPair, record: dict[str, Any], method: str) -> Figure:
    """Rendering with and without the vehicle, and their difference. The title says whether the vehicle is gone, by the
    pixels of its box."""
    title = f"Scene {record['scene']} · {method} · key frame {record['key_frame']}"
    by = "Without the vehicle's Gaussians" if record["removed_by"] == "actor" else "Without the Gaussians in the box"
    if record["subject"] is None:
        title += f"\n{record['why_null']}"
    else:
        changed, holes = record["box"]["changed_share"] or 0.0, record["holes"]["share_of_box"] or 0.0
        title += f"\n{record['gaussians_removed']:,} Gaussians removed: the vehicle is "
        figures = f"{changed:.0%} of the pixels of the box changed"
        behind = f"holes in {holes:.0%} of the box" if holes > MAX_HOLES else "no holes"
        if changed < MIN_CHANGED:
            title += f"still there, {figures} (gone: {MIN_CHANGED:.0%} or more)"
        else:
            title += f"gone, {figures}, {behind}"
    figure, axes = image_grid(pair.with_car.shape, rows=1, columns=3, title=title)
    show(axes[0], pair.with_car, "Rendering")
    show(axes[1], pair.without_car, by)
    _show_error(axes[2], pair.without_car, pair.with_car, "Absolute difference, mean over the channels")
    for axis in axes if len(pair.outline) else ():
        draw_outline(axis, pair.outline)
    return figure


def _show_error(axis: Axes, image: np.ndarray, truth: np.ndarray, title: str) -> None:
    error = axis.imshow(np.abs(image - truth).mean(axis=2), cmap="inferno", vmin=0.0, vmax=MAX_ERROR)
    axis.set_autoscale_on(False)
    axis.set_title(title, loc="left", fontsize=15)
    bar = axis.inset_axes((0.7, 0.12, 0.26, 0.03))
    axis.figure.colorbar(error, cax=bar, orientation="horizontal", ticks=[0.0, MAX_ERROR])
    bar.tick_params(colors="white", labelsize=11)


def _decibels(record: dict[str, Any] | None) -> str:
    if record is None:
        return "none"
    return "identical" if record["psnr"] is None else f"{record['psnr']:.1f} dB"
