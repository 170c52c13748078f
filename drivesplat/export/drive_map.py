"""The stage `viewer_blocks`: the viewer.html of a drive that is cut into blocks, a map with the pages of its blocks.

The page needs no network and nothing but the folder of results: it links to results/{block}/{method}/viewer.html by
relative paths. The map has the vehicle's path from above, x to the right and y up, in metres of the drive's world.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivesplat.export import drive_page as template
from drivesplat.io.html_page import filled_page
from drivesplat.io.storage import Provenance
from drivesplat.scene.blocks import Blocks, jumped
from drivesplat.scene.scene import Scene

STEP = 1.0
"""Metres between the places of the path: smaller movements of a vehicle that stands count for nothing."""
MAX_PLACES = 5000
"""Of the lines in the map, about."""
SCALE = ((230.0, 97.0, 1.0), (158.0, 102.0, 171.0), (43.0, 131.0, 186.0))
"""Red, green, blue of the lowest PSNR, of the middle and of the highest; colour-blind people tell them apart."""
GREY = "#8a939d"


@dataclass(frozen=True)
class MapLine:
    """A passage of the vehicle through a block: its `points` in SVG, and `seconds` since the block's first image."""

    points: str
    seconds: str


@dataclass(frozen=True)
class Passage:
    """A passage in words, in seconds of the drive, and its first `second` since the block's first image."""

    words: str
    second: float


@dataclass(frozen=True)
class BlockOnMap:
    """A block on the page. `page` is the address of its own page, None where it is left out; `metres` were driven in
    it; `label` is the place of its number. `gaussians`, and `psnr` of static pixels in dB, are None where they were not
    measured."""

    number: int
    name: str
    page: str | None
    metres: float
    passes: tuple[Passage, ...]
    lines: tuple[MapLine, ...]
    label: tuple[str, str]
    gaussians: int | None
    psnr: float | None
    color: str


def drive_map_page(
    scene: Scene,
    blocks: Blocks,
    starts: Mapping[str, int],
    record: Mapping[str, Any],
    method: str,
    provenance: Provenance,
) -> str:
    """The text of the page of the drive `scene`, deterministic. `starts` are the timestamps of the first images of the
    blocks that are not left out, by name, and `record` is the content of the drive's eval.json."""
    result, left_out = record["result"], record["protocol"]["left_out"]
    places = _Path.of(scene)
    known = {name: own["interpolation"]["static"] for name, own in result["blocks"].items()}
    measured = [psnr for psnr in known.values() if psnr is not None]
    bounds = (min(measured), max(measured)) if measured else None
    shown = []
    for number, (name, block) in enumerate(zip(blocks.names, blocks.blocks, strict=True)):
        start, passages = starts.get(name, 0), block.core.tolist()
        lines = (places.line(first, end, start) for first, end in passages)
        shown.append(
            BlockOnMap(
                number=number,
                name=name,
                page=None if name in left_out else f"../../{name}/{method}/viewer.html",
                metres=sum(places.length(first, end) for first, end in passages),
                passes=tuple(_passage(scene, first, end, start) for first, end in passages),
                lines=tuple(line for line in lines if line.points),
                label=_svg(block.path[len(block.path) // 2]),
                gaussians=result["blocks"].get(name, {}).get("gaussians"),
                psnr=known.get(name),
                color=_color(known.get(name), bounds),
            )
        )
    box, letters = _view(places.places)
    return filled_page(
        template,
        title=f"{scene.name} · {method}",
        provenance=provenance,
        blocks=shown,
        left_out=left_out,
        metres=places.arcs[-1],
        seconds=scene.seconds(places.last),
        gaussians=result["gaussians"],
        psnr=(result["interpolation"].get("static") or {}).get("psnr"),
        bounds=bounds,
        scale=[_hex(color) for color in SCALE],
        view_box=box,
        letters=letters,
    )


@dataclass(frozen=True)
class _Path:
    """The `times` (n,) in microseconds and `places` (n, 2) of the vehicle at images, at least STEP apart; the metres
    driven up to each (`arcs`), without jumps; and the time of the `last` image."""

    times: Int64[np.ndarray, " n"]
    places: Float64[np.ndarray, "n 2"]
    arcs: Float64[np.ndarray, " n"]
    last: int

    @classmethod
    def of(cls, scene: Scene) -> "_Path":
        found = {frame.timestamp: frame.ego_to_world[:2, 3] for frame in scene.frames}
        kept: list[int] = []
        for time in sorted(found):
            if not kept or np.linalg.norm(found[time] - found[kept[-1]]) >= STEP:
                kept.append(time)
        times, places = np.array(kept, dtype=np.int64), np.stack([found[time] for time in kept])
        moved = np.where(jumped(times, places), 0.0, np.linalg.norm(np.diff(places, axis=0), axis=1))
        return cls(times, places, np.append(0.0, np.cumsum(moved)), max(found))

    def length(self, first: int, end: int) -> float:
        """The metres that were driven between two timestamps."""
        return float(np.diff(np.interp([first, end], self.times, self.arcs))[0])

    def line(self, first: int, end: int, start: int) -> MapLine:
        """The passage in an interval [first, end) of timestamps, with seconds since `start`; empty without a place."""
        every = -(-len(self.times) // MAX_PLACES)
        rows = np.flatnonzero((self.times >= first) & (self.times < end))[::every]
        points = " ".join(",".join(_svg(place)) for place in self.places[rows])
        return MapLine(points, " ".join(f"{max(0, time - start) * 1e-6:.2f}" for time in self.times[rows].tolist()))


def _passage(scene: Scene, first: int, end: int, start: int) -> Passage:
    """The passage in an interval [first, end) of timestamps through a block whose first image is at `start`."""
    words = f"{max(0.0, scene.seconds(first)):.1f} – {scene.seconds(end):.1f}"
    return Passage(words, max(0, first - start) * 1e-6)


def _svg(place: Float64[np.ndarray, "2"]) -> tuple[str, str]:
    """A place in the coordinates of SVG, whose y points down."""
    return f"{place[0]:.1f}", f"{-place[1]:.1f}"


def _view(places: Float64[np.ndarray, "n 2"]) -> tuple[str, float]:
    """The box of the map around all places, as SVG spells it, and the size of its letters in metres."""
    lower, upper = places.min(axis=0), places.max(axis=0)
    largest = float((upper - lower).max())
    margin = 5.0 + 0.08 * largest
    (left, _), (width, height) = lower - margin, upper - lower + 2.0 * margin
    return f"{left:.1f} {-upper[1] - margin:.1f} {width:.1f} {height:.1f}", round(max(2.0, 0.02 * largest), 1)


def _color(psnr: float | None, bounds: tuple[float, float] | None) -> str:
    """The colour of a PSNR in the scale between `bounds`; GREY without one."""
    if psnr is None or bounds is None:
        return GREY
    low, high = bounds
    at = 0.5 if high == low else (psnr - low) / (high - low)
    return _hex([np.interp(at, (0.0, 0.5, 1.0), channel) for channel in zip(*SCALE, strict=True)])


def _hex(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(value):02x}" for value in color)
