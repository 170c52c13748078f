"""Frames a second of viewer.html, and what a frame takes on the page's main thread: several pages by turns, each moved
by its wheel for every frame, in headless Chromium with software WebGL.

    PYTHONPATH=tests python -m benchmarks.viewer before/viewer.html after/viewer.html

Software WebGL draws on the processor: frames a second of a graphics card are many times as high, and the first column
says little about them. The main thread sorts, unless a worker does, and hands over what is drawn: its milliseconds are
the same with a graphics card.
"""

import argparse
import statistics
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

try:
    from helpers.chromium import Tab, chromium
except ModuleNotFoundError:
    raise SystemExit("the driver of the browser is among the tests: set PYTHONPATH=tests") from None

WIDTH, HEIGHT = 320, 180
SHOWN = """new Promise((done) => {
  const look = () => document.documentElement.dataset.shown === "yes" ? done() : setTimeout(look, 50);
  look();
})"""
FRAMES = """new Promise((done) => {
  const canvas = document.querySelector("canvas");
  let [frames, step, began] = [-1, 1, 0];
  const frame = (now) => {
    if (++frames === 0) began = now;
    if (frames === %(frames)d) return done((now - began) / 1000);
    step = -step;
    canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 50 * step, cancelable: true }));
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
})"""
"""Moves the camera to and fro for so many frames; seconds."""


@dataclass(frozen=True)
class Speed:
    """Frames a second, and milliseconds of scripts on the main thread for each."""

    frames: float
    main_thread_ms: float


def measured(tab: Tab, page: Path, frames: int) -> Speed:
    """The speed of a page, newly opened."""
    tab.open(page.absolute(), WIDTH, HEIGHT)
    tab.run(SHOWN)
    tab.run(FRAMES % {"frames": 3})
    before = _script_seconds(tab)
    seconds = tab.run(FRAMES % {"frames": frames})
    return Speed(frames / seconds, 1000.0 * (_script_seconds(tab) - before) / frames)


def by_turns(pages: Sequence[Path], rounds: int, frames: int) -> list[list[Speed]]:
    """The speeds of each page, measured one after the other in every round."""
    speeds: list[list[Speed]] = [[] for _ in pages]
    for _ in range(rounds):
        for page, found in zip(pages, speeds, strict=True):
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, chromium(Path(profile)) as tab:
                tab.call("Performance.enable")
                found.append(measured(tab, page, frames))
    return speeds


def table(pages: Sequence[Path], speeds: Sequence[Sequence[Speed]]) -> str:
    """Medians as a Markdown table, with the least and the largest value."""
    lines = ["| page | frames a second | main thread, ms a frame |", "|---|---|---|"]
    for page, found in zip(pages, speeds, strict=True):
        columns = ([speed.frames for speed in found], [speed.main_thread_ms for speed in found])
        cells = (f"{statistics.median(c):.3g} ({min(c):.3g} to {max(c):.3g})" for c in columns)
        lines.append(f"| {page} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _script_seconds(tab: Tab) -> float:
    metrics = tab.call("Performance.getMetrics")["metrics"]
    return next(metric["value"] for metric in metrics if metric["name"] == "ScriptDuration")


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.viewer", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=20)
    arguments = parser.parse_args()
    print(table(arguments.pages, by_turns(arguments.pages, arguments.rounds, arguments.frames)))


if __name__ == "__main__":
    main()
