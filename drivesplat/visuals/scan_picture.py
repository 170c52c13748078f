"""The picture of LiDAR scans: recorded and rendered range image, range error, intensity and drop in rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from matplotlib import colormaps
from matplotlib.colors import Colormap, ListedColormap, LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from drivesplat.scene.scan import RenderedScan, ScanRays, wrapped
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.visuals.figures import WIDTH

RANGES = LogNorm(1.0, 100.0)
ERRORS = LogNorm(0.01, 10.0)
SHARES = Normalize(0.0, 1.0)
RANGE_COLORS, ERROR_COLORS, DROP_COLORS = (colormaps[name] for name in ("viridis_r", "plasma", "cividis"))
INTENSITY_COLORS = ListedColormap(colormaps["gray"](np.linspace(0.2, 1.0, 256)))
"""No colour of these is NO_RETURN."""
UNMEASURED = "#b7c4d6"
"""The colour of rays that say nothing."""
NO_RETURN = "black"
LEGEND = "Black: no return. Grey blue: rays that say nothing (they meet the ego vehicle, or the sensor skipped them)."
DIRECTIONS = ((180.0, "behind"), (90.0, "left"), (0.0, "ahead"), (-90.0, "right"), (-180.0, "behind"))
"""Degrees to the left of the direction of travel, and their names."""
ROW_HEIGHT, TITLE_HEIGHT, LEGEND_HEIGHT = 1.2, 0.75, 0.35
"""Inches."""


@dataclass(frozen=True)
class ShownScan:
    """A recorded scan, its rendering, and a title."""

    recorded: RecordedScan
    rendered: RenderedScan
    title: str


def draw_scans(shown: Sequence[ShownScan], ahead: float | None = None, title: str = "") -> Figure:
    """The rows of several scans, one scan below another. In the middle is the azimuth `ahead` (radians), the direction
    of travel, or the sensor's x axis (None); to its left what is to the left of it. The highest beam is above."""
    rows = [_rows(item.recorded, item.rendered) for item in shown]
    heights = [TITLE_HEIGHT + ROW_HEIGHT * len(of_scan) for of_scan in rows]
    figure = Figure(figsize=(WIDTH, sum(heights) + LEGEND_HEIGHT + (0.5 if title else 0.0)), layout="constrained")
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=18)
    figure.supxlabel(LEGEND, x=0.01, ha="left", fontsize=12)
    parts = figure.subfigures(len(shown), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, item, of_scan in zip(parts, shown, rows, strict=True):
        _draw(part, item, of_scan, ahead)
    return figure


def shown_order(rays: ScanRays, ahead: float | None) -> tuple[Int[np.ndarray, " b"], Int[np.ndarray, " a"]]:
    """The order in which beams are shown from above, and firings from the left."""
    middle = np.angle(np.exp(1j * rays.azimuths.astype(np.float64)).mean(axis=0))
    firings = np.argsort(-wrapped(middle - (ahead or 0.0)), kind="stable")
    return np.argsort(-rays.beam_elevations), firings


@dataclass(frozen=True)
class _Row:
    """A row: its title, the values of rays, those `there` are (None: all), norm, colours, ticks and their unit."""

    title: str
    values: np.ndarray
    there: np.ndarray | None
    norm: Normalize
    colors: Colormap
    ticks: tuple[float, ...]
    unit: str = " m"


def _rows(recorded: RecordedScan, rendered: RenderedScan) -> list[_Row]:
    scan = recorded.scan
    both = scan.returned & rendered.returned
    of_range = (RANGES, RANGE_COLORS, (1.0, 10.0, 100.0))
    of_error = (ERRORS, ERROR_COLORS, (0.01, 0.1, 1.0, 10.0))
    intensity, drop = (SHARES, INTENSITY_COLORS, (0.0, 0.5, 1.0), ""), (SHARES, DROP_COLORS, (0.0, 0.5, 1.0), "")
    rows = [
        _Row("Range, recorded", scan.ranges, scan.returned, *of_range),
        _Row("Range, rendered", rendered.ranges, rendered.returned, *of_range),
        _Row("Error of range, where both return", np.abs(rendered.ranges - scan.ranges), both, *of_error),
    ]
    if scan.intensities is not None:
        rows.append(_Row("Intensity, recorded", scan.intensities, scan.returned, *intensity))
    if rendered.intensities is not None:
        rows.append(_Row("Intensity, rendered", rendered.intensities, rendered.returned, *intensity))
    return [
        *rows,
        _Row("No return, recorded", ~scan.returned, None, *drop),
        _Row("Probability of no return, rendered", rendered.drops, None, *drop),
    ]


def _draw(part: SubFigure, item: ShownScan, rows: Sequence[_Row], ahead: float | None) -> None:
    part.suptitle(item.title, x=0.01, ha="left", fontsize=15)
    rays = item.recorded.scan.rays
    beams, firings = shown_order(rays, ahead)
    measured = item.recorded.measured[beams][:, firings]
    unmeasured = np.zeros((*measured.shape, 4))
    unmeasured[~measured] = to_rgba(UNMEASURED)
    elevations = [f"{degrees:+.0f}°".replace("-", "−") for degrees in np.degrees(rays.beam_elevations)[beams[[0, -1]]]]
    names = [f"{degrees:.0f}°" if ahead is None else name for degrees, name in DIRECTIONS]
    options = {"aspect": "auto", "interpolation": "nearest", "extent": (180.0, -180.0, 0.0, 1.0)}
    for axis, row in zip(part.subplots(len(rows), 1, squeeze=False)[:, 0], rows, strict=True):
        hidden = False if row.there is None else ~row.there
        values = np.ma.masked_array(np.asarray(row.values, dtype=np.float64), hidden)[beams][:, firings]
        axis.set_facecolor(NO_RETURN)
        image = axis.imshow(np.ma.masked_where(~measured, values), norm=row.norm, cmap=row.colors, **options)
        axis.imshow(unmeasured, **options)
        axis.set_title(row.title, loc="left", fontsize=12, pad=3)
        bar = axis.figure.colorbar(image, ax=axis, pad=0.005, aspect=8)
        bar.ax.yaxis.set_major_locator(FixedLocator(list(row.ticks)))
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _, unit=row.unit: f"{value:g}{unit}"))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.tick_params(labelsize=10)
        axis.set_yticks([1.0, 0.0], elevations, fontsize=10)
        last = axis.get_subplotspec().is_last_row()
        axis.set_xticks([at for at, _ in DIRECTIONS], names if last else [""] * len(names), fontsize=12)
        if last and ahead is None:
            axis.set_xlabel("azimuth from the sensor's x axis", fontsize=12)
