"""The report as files (HTML page, JSON record and CSV table), and as text for the console."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivesplat.io.storage import atomic_write, write_csv, write_json
from drivesplat.report.gaps import COLUMNS, gap_report, summary_sentences
from drivesplat.report.html import report_page
from drivesplat.report.media import collect_media
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.settings.report import ReportJob
from drivesplat.workflow.costs.measured import read_costs
from drivesplat.workflow.costs.table import scene_totals
from drivesplat.workflow.report_plan import REPORT_FILES

SHOWN = ("static", "vehicle", "moving_vehicle", "gap_db")


def write_report(
    results: Path, job: ReportJob, metrics: Sequence[str], pictures: Sequence[str], links: Sequence[str]
) -> None:
    """Writes the REPORT_FILES of these metrics.json files into the results folder, with these images and links in the
    page, and prints the table."""
    page, record, table = (results / name for name in REPORT_FILES)
    report = gap_report(list(metrics), job, results / "logs")
    media = collect_media([*pictures, *links], results)
    write_json(record, report)
    write_csv(table, COLUMNS, report["rows"])
    with atomic_write(page) as file:
        file.write(report_page(report, media, _costs(results, job)).encode())
    print(console_table(report), flush=True)


def _costs(results: Path, job: ReportJob) -> list[dict[str, Any]]:
    """The costs of the configured scenes so far."""
    stages = [name for stages in job.expected.values() for name in stages]
    methods = dict.fromkeys(name.partition("/")[0] for name in stages if "/" in name)
    totals = {total["scene"]: total for total in scene_totals(read_costs(results)[0], list(methods))}
    return [totals[scene] for scene in job.expected if scene in totals]


def console_table(report: dict[str, Any]) -> str:
    """A line per scene and method with both groups of held-out frames, means, summary sentences and missing scenes."""
    header = ["scene", "method"]
    for group in HELD_OUT_GROUPS:
        header += [f"{group[:6]}. static", "vehicle", "moving", "gap dB"]
    lines = [header, *([row["scene"], row["method"], *_cells(row)] for row in report["rows"])]
    for mean in report["means"]:
        figures = {name: found and found["mean"] for name, found in mean["figures"].items()}
        lines.append(["mean", mean["method"], *_cells(figures)])
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    table = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
    notes = [f"{item['scene']}: left out ({item['why']})" for item in report["left_out"]]
    notes += [f"{item['scene']}: {item['why']}" for item in report["missing"]]
    title = "PSNR on held-out frames" + (" (partial: see below)" if report["partial"] else "")
    return "\n".join([title, *table, *summary_sentences(report), *notes])


def _cells(figures: Mapping[str, Any]) -> list[str]:
    values = [figures[f"{group}_{name}"] for group in HELD_OUT_GROUPS for name in SHOWN]
    return ["-" if value is None else f"{value:.2f}" for value in values]
