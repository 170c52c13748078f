"""`index.html`, the page of a scene's films, and its template. It needs nothing of the report: its job is short."""

import sys
from pathlib import Path

from drivesplat.io.html_page import filled_page, write_page
from drivesplat.settings.report import FilmPageJob


def write_film_page(path: Path, job: FilmPageJob) -> None:
    """Writes the page of a scene's films to `path`, in the scene's folder of results."""
    write_page(path, filled_page(sys.modules[__name__], job=job))
