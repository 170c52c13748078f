"""Runs of Snakemake with the workflow of this copy, in the current folder."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence

from drivesplat import SNAKEFILE
from drivesplat.cli.viewer import results_folder
from drivesplat.io.this_copy import of_the_workflow

BROUGHT_ALONG = ("presets/", "profiles/")


def snakemake_command(arguments: Sequence[str]) -> list[str]:
    """The command line of Snakemake for the workflow of this copy. Presets and profiles that it brings along are found
    from any folder; the default profile is that beside the Snakefile, unless the current folder has one."""
    found = [_found(argument) for argument in arguments]
    return [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), *found]


def _found(argument: str) -> str:
    """An argument, also of the form `--option=value`, with the path of what the workflow brings along."""
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return f"{option}{equals}{of_the_workflow(value)}" if value.startswith(BROUGHT_ALONG) else argument


def run_workflow(arguments: Sequence[str]) -> int:
    """Runs Snakemake with the `arguments`. Returns its exit status."""
    # the current folder is no place to import from: it may be another copy's checkout
    process = subprocess.Popen(snakemake_command(arguments), env={**os.environ, "PYTHONSAFEPATH": "1"})
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Snakemake gets it, too, and ends its jobs first
    try:
        return process.wait()
    finally:
        signal.signal(signal.SIGINT, before)


def run_demo(cores: str) -> int:
    """Runs the whole workflow on the demo world and prints its figures. Returns the exit status."""
    status = run_workflow(["--cores", cores, "--configfile", "presets/demo.yaml", "--", "all"])
    if status == 0:
        from drivesplat.evaluation.summary import print_summary

        print_summary(results_folder() / "demo" / "metrics.json")
    return status
