"""All metrics.json into gap_report.csv, gap_report.json and a table on the console."""

from drivesplat.job import job
from drivesplat.report import console_table, gap_report, write_csv
from drivesplat.storage import write_json

with job(snakemake) as current:
    report = gap_report(list(current.input.metrics), current.param("expected"))
    write_csv(current.output.table, report)
    write_json(current.output.report, report)
    print(console_table(report), flush=True)
