"""The report of a run that failed: the rule that writes it waits for all scenes, and so never ran."""

import sys
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.report.files import ReportFiles, write_report
from drivesplat.settings.report import ReportJob
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.report_plan import REPORT_FILES, REPORT_RULES


def write_partial_report(plan: Plan) -> None:
    """Writes the report of what there is, which names what there is not; the rule replaces it once nothing fails. Says
    on the console where it lies, or why there is none."""
    there, results = plan.report([*REPORT_RULES]), Path(plan.config.results_dir)
    page, record, table = (results / name for name in REPORT_FILES)
    files, job = ReportFiles(page, record, table, results / "logs"), ReportJob.model_validate_json(there.settings())
    try:
        write_report(files, job, there.metrics(), there.pictures(), there.links())
    except (DriveSplatError, OSError) as error:
        print(f"drivesplat: there is no report of what was finished: {error}", file=sys.stderr, flush=True)
        return
    print(f"drivesplat: what was finished, and what was not, and why: {page}", file=sys.stderr, flush=True)
