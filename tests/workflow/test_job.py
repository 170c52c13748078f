"""The seam between scripts and library: what a rule's script does not wait for."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers import REPOSITORY

from drivesplat.workflow.job import Job, job

AS_A_SCRIPT = """
snakemake = None
import gc
from drivesplat.workflow.job import job
"""
AS_A_LIBRARY = AS_A_SCRIPT.replace("snakemake = None", "")
IN_A_JOB = """
from types import SimpleNamespace
told = SimpleNamespace(input=[], output=[], wildcards=[], log=["it.log"], threads=1, rule="it", params={}, resources={})
with job(told):
    print(gc.isenabled(), gc.get_freeze_count() > 1000)
"""


def output_of(code: str, folder: Path) -> str:
    """What Python prints that runs `code` in a folder."""
    environment = {"PYTHONPATH": str(REPOSITORY), "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads are counted in /proc")
@pytest.mark.parametrize("code", [AS_A_SCRIPT, AS_A_LIBRARY])
def test_a_rules_script_collects_no_garbage_of_imports_and_multiplies_matrices_in_its_own_thread(code, tmp_path):
    """A job collects its own garbage. Snakemake sets the number of OpenBLAS's threads; stages have their own, and
    OpenBLAS's wait actively."""
    asked = 'import os\nos.environ["OPENBLAS_NUM_THREADS"] = "3"\n'
    product = 'import numpy as np\nnp.ones((900, 900)) @ np.ones((900, 900))\nprint(len(os.listdir("/proc/self/task")))'
    processors = len(os.sched_getaffinity(0))
    collects, job_collects, threads = output_of(
        asked + code + f"print(gc.isenabled()){IN_A_JOB}\n{product}", tmp_path
    ).splitlines()
    assert (collects, job_collects) == (str(code is AS_A_LIBRARY), "True True")
    if processors > 1:  # OpenBLAS has one thread on one processor
        assert int(threads) == (1 if code is AS_A_SCRIPT else min(3, processors))


def test_every_script_imports_the_job_before_the_rest_of_the_library():
    for script in (REPOSITORY / "workflow_scripts").glob("*.py"):
        imported = [
            line.split()[1] for line in script.read_text().splitlines() if line.startswith(("from ", "import "))
        ]
        heavy = [name for name in imported if name.split(".")[0] not in sys.stdlib_module_names]
        assert heavy[0] == "drivesplat.workflow.job", (
            f"{script.name}: garbage is looked for while {heavy[0]} is imported"
        )


@pytest.mark.parametrize("wildcards", [{"scene": "t1"}, {"scene": "t1", "method": "t1"}, {}], ids=str)
def test_only_results_of_the_scene_are_expected_to_have_a_digest(tmp_path, caplog, wildcards):
    """A dataset may have a folder of the scene's name, too."""
    result, own = tmp_path / "results/t1/scene.json", tmp_path / "data/t1/poses.json"
    for file in (result, own):
        file.parent.mkdir(parents=True)
        file.write_text("{}")
    output = result.parent.joinpath(wildcards.get("method", "."), "own_car.json")
    told = SimpleNamespace(
        wildcards=SimpleNamespace(**wildcards), log=[], threads=1, rule="it", params={}, resources={}
    )
    told.input, told.output = [str(own), str(result)], [str(output)]
    Job(told).check_inputs()
    assert [record.args[0] for record in caplog.records] == ([result] if wildcards else [])


@pytest.mark.parametrize("when", ["as its script starts", "while it reads", "before its digest is recorded"])
def test_a_file_that_is_removed_while_a_job_runs_is_named_in_one_sentence(when, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("drivesplat.workflow.job._log_into", lambda path: None)
    read, made = tmp_path / "seed.ply", tmp_path / "parser.pkl"
    told = SimpleNamespace(wildcards=SimpleNamespace(), threads=1, rule="parser", params={}, resources={})
    told.input, told.output, told.log = [str(read)], [str(made)], [str(tmp_path / "it.log")]
    if when != "as its script starts":
        read.write_text("points")
    with pytest.raises(SystemExit), job(told):
        if when == "while it reads":
            read.unlink()
            read.read_text()
    gone = made if when == "before its digest is recorded" else read
    assert caplog.messages[-1] == f"parser: {gone} was removed while the job ran; start again"


def test_a_missing_file_that_no_rule_makes_stays_a_bug(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("drivesplat.workflow.job._log_into", lambda path: None)
    told = SimpleNamespace(wildcards=SimpleNamespace(), threads=1, rule="parser", params={}, resources={})
    told.input, told.output, told.log = [], [], [str(tmp_path / "it.log")]
    with pytest.raises(SystemExit), job(told):
        (tmp_path / "nowhere").read_text()
    assert "FileNotFoundError" in caplog.messages[-1] and "(a bug; " in caplog.messages[-1]
