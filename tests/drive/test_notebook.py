"""The notebook of the walkthrough runs from top to bottom."""

import os
import subprocess
import sys

import pytest
from helpers import REPOSITORY

NOTEBOOK = REPOSITORY / "examples/notebook.py"


@pytest.mark.slow
@pytest.mark.workflow
def test_the_notebook_runs_from_top_to_bottom(finished_run):
    environment = {
        **os.environ, "DRIVESPLAT_RESULTS": str(finished_run.folder / "results/0001"), "MPLBACKEND": "agg",
        "CUDA_VISIBLE_DEVICES": "",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, NOTEBOOK], cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "seed points" in done.stdout and "ghosts" in done.stdout and "visible" in done.stdout
