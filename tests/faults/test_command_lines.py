"""Command lines that users type by mistake or from other folders, each through Snakemake itself."""

import os
import subprocess

import pytest
from helpers import REPOSITORY
from helpers.forked_snakemake import run_snakemake
from helpers.killed_runs import only_complaint
from helpers.shared_runs import TWO_METHODS
from helpers.workflow_copy import WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("command_lines")]


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    """No test changes it."""
    return WorkflowCopy.make(tmp_path_factory.mktemp("command_lines") / "workflow", methods=TWO_METHODS)


@pytest.mark.parametrize("profile", ["default", "slurm"])
def test_a_target_after_configfile_without_dashes_is_refused_with_the_right_line(copy, profile):
    flags = ("-n", "--workflow-profile", f"profiles/{profile}", "--configfile", "mine.yaml", "all")
    assert "--configfile mine.yaml -- all" in only_complaint(copy.run(flags=flags))


@pytest.mark.slow
def test_the_workflow_runs_from_elsewhere_into_a_folder_of_its_own(copy, tmp_path):
    """Which has no config.yaml: the workflow's own holds. The demo's edits are found, too."""
    work = tmp_path / "work"
    work.mkdir()
    dataset = {"dataroot": str(copy.folder / "data"), "scenes": ["0001"]}
    away = WorkflowCopy(tmp_path, copy.config | {"datasets": {"nuscenes": dataset}})
    away.write_config()
    environment = {**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": ""}

    def run(*arguments: str) -> subprocess.CompletedProcess:
        from_elsewhere = ["-s", "workflow/Snakefile", "-d", str(work), "--cores", "2", *arguments]
        return run_snakemake(from_elsewhere, copy.folder.parent, environment, 120)

    done = run("--configfile", str(tmp_path / "mine.yaml"), "--", "results/0001/scene.json")
    assert done.returncode == 0 and (work / "results/0001/scene.json").is_file(), done.stdout
    planned = run("-n", "--configfile", "workflow/presets/demo.yaml", "--", "results/demo/street/edits/stop.mp4")
    assert planned.returncode == 0 and "rule edit:" in planned.stdout, planned.stdout


def test_make_help_lists_every_target():
    command = ["make", "--no-print-directory", "help"]
    listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    makefile = (REPOSITORY / "Makefile").read_text()
    targets = makefile.partition(".PHONY: ")[2].partition("\n")[0].split()
    assert {line.split()[1] for line in listed.splitlines()} == set(targets) - {"lint"}
