"""The frames of the film of LiDAR scans: recorded and rendered range image, and what returned, from above."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.visuals.scan_picture import (
    DIRECTIONS,
    ERROR_COLORS,
    ERRORS,
    RANGE_COLORS,
    RANGES,
    UNMEASURED,
    shown_order,
)

SIZE = (1920, 1080)
"""Width and height in pixels. Captions need the upper and the lower rim."""
DPI = 100
PAGE, INK, RING = "#14171c", "#e6e9ed", "#3a424c"
HEIGHT_COLORS = ListedColormap(colormaps["turbo"](np.linspace(0.1, 0.95, 256)))
ONLY_RENDERED, ONLY_RECORDED = "#35d07f", "#8d96a3"
MAX_SAMPLED = 20
"""Scans that decide how far and how high the views from above reach."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the frame in pixels."""

    left: int
    top: int
    width: int
    height: int

    def inside(self, frame: np.ndarray) -> np.ndarray:
        """The view of it in a frame."""
        return frame[self.top : self.top + self.height, self.left : self.left + self.width]

    def axes(self, figure: Figure) -> Axes:
        """Axes that fill it."""
        width, height = SIZE
        bottom = height - self.top - self.height
        return figure.add_axes((self.left / width, bottom / height, self.width / width, self.height / height))


RECORDED, RENDERED = Rectangle(75, 92, 1730, 108), Rectangle(75, 232, 1730, 108)
SHOWN_SHARE = 0.97
"""Share of the recorded returns that views from above reach, at least 20 m and at most 100 m."""
VIEW_SIZE, VIEW_TOP = 540, 400
VIEWS = tuple(Rectangle(left, VIEW_TOP, VIEW_SIZE, VIEW_SIZE) for left in (75, 690, 1305))
BARS = tuple(Rectangle(view.left, view.top + view.height + 10, 330, 14) for view in VIEWS)
"""The places of the colour bars of the views."""
DOT = 2
"""Pixels of a return seen from above."""


class LidarFrames:
    """The frames of a film of `scans` of one LiDAR, which all have the same scales. `ahead` is the azimuth (radians) of
    the direction of travel, None if unknown: the sensor's x axis takes its place. `title` is that of the film."""

    def __init__(self, scans: Sequence[RecordedScan], ahead: float | None, title: str):
        self._ahead = ahead
        sampled = scans[:: max(1, len(scans) // MAX_SAMPLED)]
        clouds = [_points(scan, scan.scan.ranges, scan.scan.returned & scan.measured, ahead) for scan in sampled]
        points = np.concatenate([np.zeros((1, 3)), *clouds])
        reached = np.quantile(np.abs(points[:, :2]).max(axis=1), SHOWN_SHARE)
        self.reach = float(np.clip(10.0 * np.ceil(reached / 10.0), 20.0, 100.0))
        """Metres from the sensor to the rim of a view from above."""
        low, high = np.quantile(points[:, 2], (0.01, 0.99))
        self.heights = Normalize(float(np.floor(low)), float(np.ceil(high)) + float(low == high))
        self._background = self._drawn_background(scans[0], title)

    def frame(self, recorded: RecordedScan, rendered: RenderedScan) -> UInt8[np.ndarray, "h w 3"]:
        frame, scan, measured, ahead = self._background.copy(), recorded.scan, recorded.measured, self._ahead
        beams, firings = shown_order(scan.rays, ahead)
        for place, ranges, returned in (
            (RECORDED, scan.ranges, scan.returned),
            (RENDERED, rendered.ranges, rendered.returned),
        ):
            colors = _colors(RANGE_COLORS, RANGES, ranges)
            colors[~returned] = 0
            colors[~measured] = _bytes(UNMEASURED)
            rows = beams[np.arange(place.height) * len(beams) // place.height]
            columns = firings[np.arange(place.width) * len(firings) // place.width]
            place.inside(frame)[:] = colors[rows][:, columns]  # each pixel is that of the nearest ray
        there, found = scan.returned & measured, rendered.returned & measured
        for place, ranges, chosen in zip(VIEWS, (scan.ranges, rendered.ranges), (there, found), strict=False):
            points = _points(recorded, ranges, chosen, ahead)
            self._dot(place.inside(frame), points, _colors(HEIGHT_COLORS, self.heights, points[:, 2]), points[:, 2])
        # the error where both return, at the rendered range; below it what is recorded alone, above it what is rendered
        both = there & found
        error = np.abs(rendered.ranges - scan.ranges)[both]
        parts = [
            (_points(recorded, rendered.ranges, both, ahead), _colors(ERROR_COLORS, ERRORS, error), error),
            (_points(recorded, scan.ranges, there & ~found, ahead), _bytes(ONLY_RECORDED), -1.0),
            (_points(recorded, rendered.ranges, found & ~there, ahead), _bytes(ONLY_RENDERED), np.inf),
        ]
        points = np.concatenate([cloud for cloud, _, _ in parts])
        colors = np.concatenate([np.broadcast_to(color, (len(cloud), 3)) for cloud, color, _ in parts])
        order = np.concatenate([np.broadcast_to(order, len(cloud)) for cloud, _, order in parts])
        self._dot(VIEWS[2].inside(frame), points, colors, order)
        return frame

    def _dot(self, view: np.ndarray, points: np.ndarray, colors: np.ndarray, order: np.ndarray) -> None:
        """Draws points (n, 3), ahead, to the left and up, as dots into a view from above; the last in order are on
        top."""
        scale = VIEW_SIZE / (2.0 * self.reach)
        places = np.floor(VIEW_SIZE / 2 - scale * points[:, :2]).astype(int)
        chosen = np.argsort(order, kind="stable")
        chosen = chosen[((places[chosen] >= 0) & (places[chosen] <= VIEW_SIZE - DOT)).all(axis=1)]
        rows, columns = places[chosen].T
        for i in range(DOT):
            for j in range(DOT):
                view[rows + i, columns + j] = colors[chosen]

    def _drawn_background(self, scan: RecordedScan, title: str) -> UInt8[np.ndarray, "h w 3"]:
        """What all frames have: titles, scales, rings of distance, and what colours mean."""
        figure = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI, facecolor=PAGE)
        canvas = FigureCanvasAgg(figure)
        elevations = np.degrees(scan.scan.rays.beam_elevations)
        for place, name in ((RECORDED, "Range, recorded"), (RENDERED, "Range, rendered")):
            axis = _panel(figure, place, name)
            axis.set_yticks([1.0, 0.0], [f"{e:+.0f}°".replace("-", "−") for e in (elevations.max(), elevations.min())])
            axis.set_xlim(180.0, -180.0)
            names = [f"{degrees:.0f}°" if self._ahead is None else word for degrees, word in DIRECTIONS]
            axis.set_xticks([degrees for degrees, _ in DIRECTIONS], names if place is RENDERED else [])
        _bar(figure, Rectangle(1830, 92, 16, 248), RANGE_COLORS, RANGES, (1.0, 10.0, 100.0), "{:g} m")
        titles = ("From above, recorded", "From above, rendered", "Error of range, from above")
        step = 10.0 if self.reach <= 40.0 else 20.0
        for place, name in zip(VIEWS, titles, strict=True):
            axis = _panel(figure, place, name)
            axis.set_xlim(self.reach, -self.reach)
            axis.set_ylim(-self.reach, self.reach)
            for radius in np.arange(step, self.reach * 1.5, step).tolist():
                axis.add_patch(Circle((0.0, 0.0), radius, fill=False, edgecolor=RING, linewidth=0.8))
                if radius < self.reach:
                    axis.text(0.0, -radius, f"{radius:g} m", color=ONLY_RECORDED, fontsize=9, ha="center", va="center")
            axis.plot(0.0, 0.0, marker="^", color=INK, markersize=7)
            axis.set_xticks([])
            axis.set_yticks([])
        low, high = float(self.heights.vmin), float(self.heights.vmax)
        heights = sorted({low, min(max(0.0, low), high), high})
        for place in BARS[:2]:
            _bar(figure, place, HEIGHT_COLORS, self.heights, heights, "{:+.0f} m")
        _bar(figure, BARS[2], ERROR_COLORS, ERRORS, (0.01, 0.1, 1.0, 10.0), "{:g} m")
        for bar, text in zip(BARS, ("height above the sensor",) * 2 + ("where both return",), strict=True):
            _write(figure, text, bar.left + bar.width + 12, bar.top + 12, INK)
        _write(figure, title, 1775, 44, INK, size=15, ha="right")
        _write(figure, "ahead is up" if self._ahead is not None else "the x axis is up", 615, 392, INK, ha="right")
        _write(figure, "only rendered", 1845, 392, ONLY_RENDERED, ha="right")
        _write(figure, "only recorded", 1705, 392, ONLY_RECORDED, ha="right")
        _write(figure, "black: no return, grey blue: says nothing", 1805, 84, ONLY_RECORDED, ha="right")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _points(
    recorded: RecordedScan, ranges: Float[np.ndarray, "b a"], chosen: Bool[np.ndarray, "b a"], ahead: float | None
) -> Float[np.ndarray, "n 3"]:
    """Points at `ranges` of the `chosen` rays: metres ahead, to the left and up, from the sensor at their times."""
    points = recorded.scan.rays.directions()[chosen].astype(np.float64) * ranges[chosen, None]
    cosine, sine = np.cos(ahead or 0.0), np.sin(ahead or 0.0)
    return points @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _colors(colors: Colormap, norm: Normalize, values: np.ndarray) -> np.ndarray:
    """The colours (..., 3) of values as bytes."""
    return colors(np.asarray(norm(np.maximum(values, 1e-6 if norm.vmin > 0 else norm.vmin))), bytes=True)[..., :3]


def _bytes(color: str) -> UInt8[np.ndarray, "3"]:
    return np.round(255.0 * np.array(to_rgb(color))).astype(np.uint8)


def _panel(figure: Figure, place: Rectangle, title: str) -> Axes:
    axis = place.axes(figure)
    axis.set_facecolor("black")
    axis.set_title(title, loc="left", fontsize=13, color=INK, pad=5)
    axis.tick_params(colors=INK, labelsize=11, color=INK)
    for spine in axis.spines.values():
        spine.set_visible(False)
    return axis


def _bar(
    figure: Figure, place: Rectangle, colors: Colormap, norm: Normalize, ticks: Sequence[float], form: str
) -> None:
    orientation = "horizontal" if place.width > place.height else "vertical"
    bar = figure.colorbar(ScalarMappable(norm, colors), cax=place.axes(figure), orientation=orientation)
    labels = [form.format(tick).replace("-", "−").replace("+0 ", "0 ") for tick in ticks]
    bar.set_ticks(list(ticks), labels=labels, minor=False)
    bar.minorticks_off()
    bar.ax.tick_params(colors=INK, labelsize=11)


def _write(figure: Figure, text: str, x: int, y: int, color: str, size: int = 12, ha: str = "left") -> None:
    """Writes text whose baseline is at `y` pixels from above."""
    figure.text(x / SIZE[0], 1.0 - y / SIZE[1], text, color=color, fontsize=size, ha=ha, va="baseline")
