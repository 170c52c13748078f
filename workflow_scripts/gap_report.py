"""All metrics.json, and what there is to see, into gap_report.html, .csv, .json and a table on the console."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.report.files import ReportFiles, write_report
from drivesplat.settings.report import ReportJob

with job(snakemake, check_inputs=False) as current:
    made = current.output
    files = ReportFiles(Path(made.page), Path(made.report), Path(made.table), Path(current.log[0]).parent)
    write_report(files, current.settings(ReportJob), current.input.metrics, current.input.pictures, current.input.links)
