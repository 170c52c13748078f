"""Figures of images in a grid with titles, 1600 pixels wide."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from drivesplat.io.storage import atomic_write

DPI = 100
WIDTH = 16.0
"""Inches."""
BOX = "#ffd166"
"""The colour of box outlines."""


def save_figure(path: str | Path, figure: Figure) -> None:
    """Writes a PNG. Raises ResultError naming `path` if that fails."""
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI, facecolor="white")


def image_grid(shape: tuple[int, ...], rows: int, columns: int, title: str) -> tuple[Figure, list[Axes]]:
    """A landscape figure for images of `shape` (h, w, ...), and its axes row by row."""
    image_height = WIDTH / columns * shape[0] / shape[1]
    figure = Figure(figsize=(WIDTH, rows * (image_height + 0.35) + 0.85), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=18, x=0.01, ha="left")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(rows * columns)]
    for axis in axes:
        axis.set_axis_off()
    return figure, axes


def show(axis: Axes, image: np.ndarray, title: str) -> None:
    """Draws an image (h, w, 3) in [0, 1] with a title above it."""
    axis.imshow(image)
    axis.set_autoscale_on(False)  # overlays may extend beyond the image
    axis.set_title(title, loc="left", fontsize=15)


def draw_outline(axis: Axes, polygon: np.ndarray, color: str = BOX, line: str = "solid") -> np.ndarray:
    """Draws the outline (n, 2) of a box, in continuous pixels, over an image; returns it in axes coordinates. `line` is
    a line style of matplotlib."""
    outline = polygon - 0.5
    axis.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=1.5, linestyle=line))
    return outline
