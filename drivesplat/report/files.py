"""The report as files (gap_report.html, a page with embedded images that needs no network, JSON record and CSV table),
and as text for the console."""

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import markdown
import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from snakemake.common import get_report_id
from snakemake.iocontainers import FILE_HASH_PREFIX_LEN

from drivesplat import WORKFLOW
from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.evaluation.published_fixes import GHOSTS_DOCUMENT, PUBLISHED_FIXES
from drivesplat.io.html_page import filled_page, write_page
from drivesplat.io.storage import write_json
from drivesplat.report import ghosts_page, page
from drivesplat.report.aside import aside_table
from drivesplat.report.gaps import gap_report, moving_gap, shows_other_tracks, shows_people, summary_sentences
from drivesplat.report.lidar import page_table
from drivesplat.report.media import MethodMedia, collect_media, data_url, difference_position, read_image
from drivesplat.report.runs import run_rows, run_table
from drivesplat.report.tables import (
    aside_tables,
    gap_table,
    lidar_tables,
    pixels_label,
    published_tables,
    scene_label,
    whole_image_table,
    write_figures,
)
from drivesplat.settings.report import ReportJob
from drivesplat.workflow.costs.measured import read_costs
from drivesplat.workflow.costs.table import scene_totals
from drivesplat.workflow.film_names import FILM_PAGE
from drivesplat.workflow.report_plan import REPORT_FILES

_PICTURE = re.compile(r"!\[([^\]\n]*)\]\(([^)\s]+)\)")
_LINK = re.compile(r"\[([^\]\n]+)\]\((?!https?:)[^)\s]+\)")
"""A link to another document, which the page does not come with."""
MediaByMethod = Mapping[tuple[str, str], MethodMedia]
NAMES = [{"key": name, "title": name, "form": "{}", "kind": "name"} for name in ("scene", "method", "tracks")]
REGION_FIGURES = [
    {"key": "moving_vehicle", "title": "moving", "form": "{:.1f}", "kind": "first"},
    {"key": "static", "title": "static", "form": "{:.1f}", "kind": ""},
    {"key": "vehicle", "title": "vehicle", "form": "{:.1f}", "kind": ""},
    {"key": "gap_db", "title": "gap", "form": "{:.1f}", "kind": ""},
]
HUMAN_FIGURES = [
    {"key": "moving_human", "title": "people", "form": "{:.1f}", "kind": "first"},
    {"key": "human_gap_db", "title": "gap", "form": "{:.1f}", "kind": ""},
]
WHOLE_IMAGE_FIGURES = [
    {"key": "psnr", "title": "PSNR ↑", "form": "{:.1f}", "kind": "first"},
    {"key": "ssim", "title": "SSIM ↑", "form": "{:.3f}", "kind": ""},
    {"key": "lpips", "title": "LPIPS ↓", "form": "{:.3f}", "kind": ""},
]
"""The columns of a group of held-out frames: key of the figure, title, format and CSS class."""
PUBLISHED_FIGURES = [
    *(
        {**column, "form": form}
        for column, form in zip(WHOLE_IMAGE_FIGURES, ("{:.2f}", "{:.3f}", "{:.3f}"), strict=True)
    ),
    {"key": "train_minutes", "title": "training, min", "form": "{:.1f}", "kind": "first"},
    {"key": "gpu", "title": "GPU", "form": "{}", "kind": "name"},
]
COSTS = [
    {"key": "gaussians", "title": "Gaussians", "form": "{:,.0f}", "kind": "first"},
    {"key": "train_seconds", "title": "training, s", "form": "{:,.0f}", "kind": ""},
]
PLOT_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""A palette for colour-blind readers (Okabe and Ito 2008)."""
_STYLE = {"svg.fonttype": "none", "svg.hashsalt": "drivesplat", "font.family": "sans-serif", "font.size": 10}


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
    write_page(ghosts, render_ghosts_page())
    write_page(page, report_page(report, media, costs))
    write_page(archived, report_page(report, packed, costs, lambda name: address_in_archive(results / name)))
    print(console_table(report), flush=True)


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


def report_page(
    report: dict[str, Any],
    media: MediaByMethod,
    costs: Sequence[dict[str, Any]] = (),
    address: Callable[[str], str] = str,
) -> str:
    """The page of a report with the `media` by scene and method and the total costs of scenes. `address` gives the
    links to files by their paths relative to the results folder, by default these paths. Raises ResultError if an image
    cannot be read."""
    scenes: dict[str, list[dict[str, Any]]] = {}
    for row in report["rows"]:
        scenes.setdefault(row["scene"], []).append(row)
    names = NAMES if shows_other_tracks(report) else NAMES[:-1]
    configured = len(scenes) + len(report["left_out"]) + len(report["missing"])
    # the tables of published figures by publication, whose rows have those measured on the same scenes
    published, place = report["published"], itemgetter("scene", "scenes", "group", "region")
    tables: dict[str, dict[str, Any]] = {}
    for before, row in zip([None, *published], published, strict=False):
        table = tables.setdefault(row["source"], {"source": row["source"], "url": row["url"], "rows": []})
        first = not row["measured"] and before is not None and place(before) != place(row)
        table["rows"].append({**row, "scene_label": scene_label(row), "pixels": pixels_label(row), "first": first})
    return filled_page(
        page,
        report=report,
        reference=report["reference"] or "a method without moving parts",
        state=f"{len(scenes)} of {configured} configured scenes",
        nothing="Nothing has been measured yet.",
        sentences=summary_sentences(report),
        plot=Markup(gap_plot(report)),
        places=GROUP_PLACES,
        tables=[
            _table("Moving vehicles and static pixels: PSNR in dB", names, REGION_FIGURES, []),
            *([_table("Moving people: PSNR in dB", names, HUMAN_FIGURES, [])] if shows_people(report) else []),
            _table("Whole images, with the cost of training", names, WHOLE_IMAGE_FIGURES, COSTS),
        ],
        aside=aside_table(report["aside"]),
        lidar=page_table(report["lidar"]),
        runs=run_table(report.get("runs", ())),
        publications=list(tables.values()),
        published_columns=PUBLISHED_FIGURES,
        scenes=scenes,
        links_of=lambda scene: media.get((scene, ""), MethodMedia()).links,
        media_of=lambda row: _looks(row, media.get((row["scene"], row["method"]), MethodMedia())),
        address=address,
        film_page=FILM_PAGE,
        fixes=PUBLISHED_FIXES,
        document=GHOSTS_DOCUMENT,
        costs=costs,
        timed_methods=list(dict.fromkeys(method for total in costs for method in total["seconds_by_method"])),
    )


def _table(
    title: str, names: list[dict[str, str]], of_groups: list[dict[str, str]], of_methods: list[dict[str, str]]
) -> dict[str, Any]:
    """A table of figures `of_groups` of held-out frames and `of_methods`, after columns of `names`: its title, the
    titles of groups of columns with their numbers of columns, the number of names, and the columns."""
    figures = [{**column, "key": f"{group}_{column['key']}"} for group in GROUP_PLACES for column in of_groups]
    groups = [(place, len(of_groups)) for place in GROUP_PLACES.values()]
    groups += [("", len(of_methods))] if of_methods else []
    return {"title": title, "groups": groups, "names": len(names), "columns": [*names, *figures, *of_methods]}


def _looks(row: dict[str, Any], media: MethodMedia) -> dict[str, Any]:
    """The images of a method on a scene, embedded: pairs to compare, each starting where they differ, the ghost panel,
    and LiDAR scans; and its links."""
    shown, where = row["shown"], "an image"
    if shown is not None:
        of_group = "a training image" if shown["group"] == "train" else f"held out {GROUP_PLACES[shown['group']]}"
        where = f"key frame {shown['key_frame']}, {of_group}"
    pairs = (
        ("recorded", "rendered", "recorded", row["method"], where),
        ("with_car", "without_car", "with vehicle", "without vehicle", "with and without a vehicle"),
    )
    comparisons = []
    for below, above, left, right, what in pairs:
        if below in media.images and above in media.images:
            under, over = read_image(media.images[below]), read_image(media.images[above])
            start = f"{100 * difference_position(under, over):.1f}"
            images = {"under": data_url(under), "over": data_url(over)}
            comparisons.append({"left": left, "right": right, "what": what, "start": start, **images})
    panel, lidar = (
        data_url(read_image(media.images[name])) if name in media.images else None for name in ("panel", "lidar")
    )
    return {"comparisons": comparisons, "panel": panel, "lidar": lidar, "links": media.links}


def gap_plot(report: dict[str, Any]) -> str:
    """The gap in dB as an SVG: for each group of held-out frames with moving vehicles a dot per scene and method, and
    the mean with its interval. Empty without a gap."""
    drawn = [g for g in GROUP_PLACES if any(mean["figures"][f"{g}_gap_db"] for mean in report["means"])]
    if not drawn:
        return ""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(4.4 * len(drawn), 3.4), layout="constrained")
        axes = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
        methods = [mean["method"] for mean in report["means"]]
        for panel, group in zip(axes, drawn, strict=True):
            for at, mean in enumerate(report["means"]):
                color = PLOT_COLORS[at % len(PLOT_COLORS)]
                gaps = [moving_gap(row, group) for row in report["rows"] if row["method"] == mean["method"]]
                known = sorted(gap for gap in gaps if gap is not None)
                offsets = 0.28 * np.linspace(-1.0, 1.0, len(known)) if len(known) > 1 else np.zeros(len(known))
                panel.plot(at + offsets, known, "o", color=color, alpha=0.45, markersize=5)
                found = mean["figures"][f"{group}_gap_db"]
                if found:
                    panel.plot([at - 0.36, at + 0.36], [found["mean"]] * 2, color=color, linewidth=2.5)
                    if found["low"] is not None:
                        panel.plot([at, at], [found["low"], found["high"]], color=color, linewidth=2.5)
            panel.axhline(0.0, color="#888888", linewidth=0.8)
            panel.set_xticks(range(len(methods)), methods)
            panel.set_xlim(-0.6, len(methods) - 0.4)
            panel.set_title(GROUP_PLACES[group], fontsize=11)
            panel.grid(axis="y", color="#dddddd", linewidth=0.6)
            panel.set_axisbelow(True)
            panel.spines[["top", "right"]].set_visible(False)
        axes[0].set_ylabel("gap: static minus moving vehicles, dB")
        drawing = io.StringIO()
        figure.savefig(drawing, format="svg", metadata={"Date": None, "Creator": None})
    text = drawing.getvalue()
    return text[text.index("<svg") :]
