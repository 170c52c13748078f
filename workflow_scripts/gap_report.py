"""All metrics.json, and what there is to see, into gap_report.html, .csv, .json and a table on the console."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.report.files import write_report
from drivesplat.settings.report import ReportJob

with job(snakemake, check_inputs=False) as current:
    results, found = Path(current.output.page).parent, current.input
    links = snakemake.params.links
    write_report(results, current.settings(ReportJob), found.metrics, found.pictures, links, found.runs)
