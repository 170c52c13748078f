"""The report as files (HTML page, JSON record and CSV table), and as text for the console."""

import base64
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import markdown
from markupsafe import Markup
from snakemake.common import get_report_id
from snakemake.iocontainers import FILE_HASH_PREFIX_LEN

from drivesplat import WORKFLOW
from drivesplat.evaluation.published_fixes import GHOSTS_DOCUMENT, PUBLISHED_FIXES
from drivesplat.io.html_page import filled_page
from drivesplat.io.storage import atomic_write, write_json
from drivesplat.report import film_page, ghosts_page
from drivesplat.report.gaps import gap_report, summary_sentences
from drivesplat.report.html import report_page
from drivesplat.report.media import collect_media
from drivesplat.report.runs import run_rows
from drivesplat.report.tables import (
    aside_tables,
    gap_table,
    lidar_tables,
    published_tables,
    whole_image_table,
    write_figures,
)
from drivesplat.settings.report import FilmPageJob, ReportJob
from drivesplat.workflow.costs.measured import read_costs
from drivesplat.workflow.costs.table import scene_totals
from drivesplat.workflow.film_names import FILM_PAGE
from drivesplat.workflow.report_plan import REPORT_FILES

_PICTURE = re.compile(r"!\[([^\]\n]*)\]\(([^)\s]+)\)")
_LINK = re.compile(r"\[([^\]\n]+)\]\((?!https?:)[^)\s]+\)")
"""A link to another document, which the page does not come with."""


def write_report(
    results: Path,
    job: ReportJob,
    metrics: Sequence[str],
    pictures: Sequence[str],
    links: Sequence[str],
    runs: Sequence[str] = (),
) -> None:
    """Writes the REPORT_FILES of these metrics.json files and records of runs into the results folder, with these
    images and links in the page, and prints the table."""
    page, record, table, ghosts, archived = (results / name for name in REPORT_FILES)
    report = {**gap_report(list(metrics), job, results / "logs"), "runs": run_rows(runs)}
    media = collect_media([*pictures, *links], results)
    # the archive has films, but not the pages that show them
    packed = collect_media([*pictures, *(link for link in links if Path(link).name != FILM_PAGE)], results)
    write_json(record, report)
    write_figures(table, report)
    # the costs of the configured scenes so far
    of_scenes = {
        scene: list(dict.fromkeys(name.partition("/")[0] for name in stages if "/" in name))
        for scene, stages in job.expected.items()
    }
    totals = {total["scene"]: total for total in scene_totals(read_costs(results)[0], (), of_scenes)}
    costs = [totals[scene] for scene in job.expected if scene in totals]
    _write_page(ghosts, render_ghosts_page())
    _write_page(page, report_page(report, media, costs))
    _write_page(archived, report_page(report, packed, costs, lambda name: address_in_archive(results / name)))
    print(console_table(report), flush=True)


def write_film_page(path: Path, job: FilmPageJob) -> None:
    """Writes the page of a scene's films to `path`, in the scene's folder of results."""
    _write_page(path, filled_page(film_page, job=job))


def _write_page(path: Path, page: str) -> None:
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as file:
        file.write(page.encode())


def console_table(report: dict[str, Any]) -> str:
    """PSNR by region, the metrics of whole images, of views from beside the path and of LiDAR scans as tables with a
    line per scene and method and means, summary sentences, and missing scenes."""
    notes = [f"{item['scene']}: left out ({item['why']})" for item in report["left_out"]]
    notes += [f"{item['scene']}: {item['why']}" for item in report["missing"]]
    title = "PSNR in dB on held-out frames" + (" (partial: see below)" if report["partial"] else "")
    tables = [gap_table(report), "Whole images", whole_image_table(report)] if report["rows"] else []
    more = [*aside_tables(report), *lidar_tables(report), *published_tables(report)]
    return "\n".join([title, *tables, *more, *summary_sentences(report), *notes])


def address_in_archive(result: Path) -> str:
    """The address of a result, marked `report` in its rule, from a page beside it in the archive. `result` is the path
    that its rule declares, relative to the working folder."""
    return f"../{get_report_id(result)[:FILE_HASH_PREFIX_LEN]}/{result.name}"


def render_ghosts_page(document: Path | None = None) -> str:
    """The page; `document` is by default that of the workflow. Without it, the page names the published fixes only."""
    document = document or WORKFLOW / GHOSTS_DOCUMENT
    text = document.read_text(encoding="utf-8") if document.is_file() else ""
    pictures = _PICTURE.sub(lambda found: _embedded(found[1], document.parent / found[2]), text)
    content = markdown.markdown(_LINK.sub(r"\1", pictures), extensions=["tables", "sane_lists"])
    return filled_page(ghosts_page, fixes=PUBLISHED_FIXES, document=GHOSTS_DOCUMENT, content=Markup(content))


def _embedded(text: str, picture: Path) -> str:
    """A picture as HTML that needs no other file; nothing where it is missing."""
    if not picture.is_file():
        return ""
    content = base64.b64encode(picture.read_bytes()).decode()
    return f'<img alt="{text}" src="data:image/{picture.suffix[1:]};base64,{content}">'
