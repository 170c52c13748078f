"""The picture of a LiDAR scan: recorded and rendered range image, range error, intensity and drop in rows."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from drivesplat.inspection.figures import WIDTH
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan

RANGES = LogNorm(1.0, 100.0)
ERRORS = LogNorm(0.01, 10.0)
SHARES = Normalize(0.0, 1.0)
UNMEASURED = "#b7c4d6"
"""The colour of rays that say nothing."""
NO_RETURN = "black"
ROW_HEIGHT = 1.35
"""Inches."""


def draw_scan(recorded: RecordedScan, rendered: RenderedScan, title: str) -> Figure:
    """The rows of a scan. Azimuth falls from 180 degrees, clockwise, with the sensor's x axis in the middle; the
    highest beam is above. Rays without a return are black, rays that say nothing grey."""
    scan = recorded.scan
    both = scan.returned & rendered.returned
    rows = [
        (RANGES, "viridis_r", "Range, recorded (m)", scan.ranges, scan.returned),
        (RANGES, "viridis_r", "Range, rendered (m)", rendered.ranges, rendered.returned),
        (ERRORS, "inferno", "Range error where both return (m)", np.abs(rendered.ranges - scan.ranges), both),
        *(
            (SHARES, "gray", f"Intensity, {name}", values, there)
            for name, values, there in (
                ("recorded", scan.intensities, scan.returned),
                ("rendered", rendered.intensities, rendered.returned),
            )
            if values is not None
        ),
        (SHARES, "cividis", "No return, recorded", ~scan.returned, None),
        (SHARES, "cividis", "No return, rendered (probability)", rendered.drops, None),
    ]
    figure = Figure(figsize=(WIDTH, 0.6 + ROW_HEIGHT * len(rows)), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=17)
    beams = np.argsort(-np.median(scan.rays.elevations, axis=1))
    firings = np.argsort(-_column_azimuths(scan.rays.azimuths), kind="stable")
    for axis, (norm, colors, name, values, there) in zip(figure.subplots(len(rows), 1), rows, strict=True):
        shown = np.ma.masked_array(np.asarray(values, dtype=np.float64), False if there is None else ~there)
        _show(axis, norm, colors, name, shown[beams][:, firings], recorded.measured[beams][:, firings])
    return figure


def _column_azimuths(azimuths: np.ndarray) -> np.ndarray:
    """The mean azimuth of each firing."""
    return np.angle(np.exp(1j * azimuths.astype(np.float64)).mean(axis=0))


def _show(axis: Axes, norm: Normalize, colors: str, name: str, values: np.ma.MaskedArray, measured: np.ndarray) -> None:
    axis.set_facecolor(NO_RETURN)
    options = {"aspect": "auto", "interpolation": "nearest", "extent": (180.0, -180.0, 0.0, 1.0)}
    image = axis.imshow(np.ma.masked_where(~measured, values), norm=norm, cmap=colors, **options)
    grey = np.zeros((*measured.shape, 4))
    grey[~measured] = [*(int(UNMEASURED[i : i + 2], 16) / 255.0 for i in (1, 3, 5)), 1.0]
    axis.imshow(grey, **options)
    axis.set_title(name, loc="left", fontsize=12, pad=3)
    axis.set_yticks([])
    axis.set_xticks(np.arange(-180, 181, 45) if axis.get_subplotspec().is_last_row() else [])
    axis.tick_params(labelsize=10)
    axis.figure.colorbar(image, ax=axis, pad=0.005, aspect=8).ax.tick_params(labelsize=9)
