"""Runs of Snakemake that are killed or fail."""

import subprocess
from contextlib import chdir
from pathlib import Path

import pytest

from drivesplat.errors import DriveSplatError
from drivesplat.workflow.plan import Plan
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy, complaints


def only_complaint(done: subprocess.CompletedProcess) -> str:
    """The one line that a failed run says, checked to be one line and no traceback."""
    assert done.returncode != 0, done.stdout
    assert "Traceback" not in done.stdout, done.stdout
    lines = complaints(done.stdout)
    assert len(lines) == 1, done.stdout
    return lines.pop()


def refusal_by_plan(copy: WorkflowCopy, *targets: str) -> str:
    """The sentence with which the plan refuses a run, asked as the Snakefile asks it, in the folder of the copy."""
    with chdir(copy.folder), pytest.raises(DriveSplatError) as refused:
        plan = Plan(copy.config, str(REPOSITORY))
        plan.edits()
        plan.runs()
        plan.refuse_unknown([*targets])
        plan.refuse_absent_data([*targets])
    assert "\n" not in str(refused.value)
    return str(refused.value)


def training_process(copy: WorkflowCopy) -> int | None:
    """The process id of the running train.py of this copy."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                arguments = (entry / "cmdline").read_bytes().split(b"\0")
                where = str((entry / "cwd").readlink())
            except OSError:
                continue
            scripted = b"python" in arguments[0] and any(a.endswith(b".train.py") for a in arguments)
            if scripted and where == str(copy.folder):
                return int(entry.name)
    return None
