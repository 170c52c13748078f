"""Runs of Snakemake that are killed or fail."""

import subprocess
from pathlib import Path

from helpers.workflow_copy import WorkflowCopy, complaints


def only_complaint(done: subprocess.CompletedProcess) -> str:
    """The one line that a failed run says, checked to be one line and no traceback."""
    assert done.returncode != 0, done.stdout
    assert "Traceback" not in done.stdout, done.stdout
    lines = complaints(done.stdout)
    assert len(lines) == 1, done.stdout
    return lines.pop()


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
