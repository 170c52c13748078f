"""The report of a failed run, whose rule for the report did not run."""

import sys
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.report.files import write_report
from drivesplat.settings.report import ReportJob
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.report_plan import REPORT_FILES, REPORT_RULES


def write_partial_report(plan: Plan) -> None:
    """Writes a report of the finished scenes that names the missing ones; the rule replaces it in a later run. Prints
    its path, or why it cannot be written."""
    inputs, results = plan.report([*REPORT_RULES]), Path(plan.config.results_dir)
    page = results / REPORT_FILES[0]
    job = ReportJob.model_validate_json(inputs.settings())
    try:
        write_report(results, job, inputs.metrics(), inputs.pictures(), inputs.links())
    except (DriveSplatError, OSError) as error:
        print(f"drivesplat: the report of the finished scenes cannot be written: {error}", file=sys.stderr, flush=True)
        return
    print(f"drivesplat: report of finished and missing scenes: {page}", file=sys.stderr, flush=True)
