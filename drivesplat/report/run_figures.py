"""What a finished run says of its figures: a table of its scenes, and where its pages are."""

import sys
from collections.abc import Iterable
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.evaluation.figures_table import METRICS_FILE, figures_table, metrics_of
from drivesplat.workflow.film_names import FILM_PAGE
from drivesplat.workflow.report_plan import REPORT_FILES

MAX_SCENES = 12
"""Scenes in the table at most."""


def print_run_figures(outputs: Iterable[str], results: Path) -> None:
    """Prints the figures of the scenes whose metrics.json is among the `outputs` of a run's jobs, finished ones too,
    and the paths of their pages and of the report. Nothing where a run makes neither. A damaged file is named."""
    files = sorted({Path(output) for output in outputs})
    of_scenes = [file for file in files if file.parent.parent == results and file.is_file()]
    measured = [file for file in of_scenes if file.name == METRICS_FILE]
    try:
        table = figures_table([metrics_of(file)[1] for file in measured[:MAX_SCENES]])
    except DriveSplatError as error:
        table = [f"the figures of this run cannot be shown: {error}"]
    if len(measured) > MAX_SCENES:
        table.append(f"… and {len(measured) - MAX_SCENES} scenes more")
    places = {
        "figures": measured,
        "films": [file for file in of_scenes if file.name == FILM_PAGE],
        "report": [file for file in files if file == results / REPORT_FILES[0] and file.is_file()],
    }
    named = [f"{name}: {_named(found)}" for name, found in places.items() if found]
    lines = [*table, *named] if table else [*["results of this run"][: len(named)], *named]
    if lines:
        print("\n  ".join([f"drivesplat: {lines[0]}", *lines[1:]]), file=sys.stderr, flush=True)


def _named(files: list[Path]) -> str:
    more = f" and {len(files) - MAX_SCENES} more" if len(files) > MAX_SCENES else ""
    return ", ".join(map(str, files[:MAX_SCENES])) + more
