"""The workflow through a real SLURM: its profile, and that results are those of a local run. `make test-slurm`"""

import os
import re
import shutil
import subprocess

import pytest
import yaml
from helpers.patience import PATIENCE_S
from helpers.workflow_copy import REPOSITORY, WorkflowCopy

PROFILES = REPOSITORY / "profiles"
TARGET = "results/0001/metrics.json"
ON_SLURM = (
    "--workflow-profile", "profiles/slurm", "--slurm-no-account", "--slurm-status-command", "squeue",
    "--slurm-init-seconds-before-status-checks", "3", "--seconds-between-status-checks", "3",
)  # fmt: skip


def test_the_profile_for_slurm_reruns_what_the_default_one_does():
    """It stands in for the default profile, which alone would be read otherwise."""
    default, slurm = (yaml.safe_load((PROFILES / name / "config.yaml").read_text()) for name in ("default", "slurm"))
    own = {"__use_yte__", "__definitions__", "resources"}
    assert {key: slurm.get(key) for key in default.keys() - own} == {k: v for k, v in default.items() if k not in own}
    assert slurm["executor"] == "slurm" and "resources" not in slurm, "SLURM knows the number of GPUs"


@pytest.mark.slurm
@pytest.mark.skipif(shutil.which("sinfo") is None, reason="no SLURM here: make test-slurm")
def test_a_scene_through_slurm_comes_out_as_one_that_runs_here(tmp_path):
    copies = {name: WorkflowCopy.make(tmp_path / name, methods={"vanilla": {}}) for name in ("here", "there")}
    assert copies["here"].run(TARGET).returncode == 0
    there = copies["there"]
    there.config["device"] = "any"  # the GPUs configured in SLURM do not exist
    there.write_config()
    environment = {**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": "0"}
    done = subprocess.run(
        there.command(*ON_SLURM, "--", TARGET), cwd=there.folder, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    jobs = re.findall(r"submitted with SLURM jobid (\d+) \(log: \S*/rule_(\w+)/", done.stdout)
    assert {rule for _, rule in jobs} >= {"extract", "parser", "masks", "train", "evaluate", "scene_metrics"}
    asked = {rule: show(number) for number, rule in jobs}
    for rule, gpu in (("train", True), ("evaluate", True), ("extract", False), ("masks", False)):
        assert ("gres:gpu:1" in asked[rule]) == gpu, f"{rule} asks for a GPU: {gpu}"
    assert "cpu=2,mem=16000M" in asked["train"] and "TimeLimit=04:00:00" in asked["train"]
    results = [copy.read(TARGET)["methods"]["vanilla"] for copy in copies.values()]
    for group in ("interpolation", "extrapolation"):
        here, elsewhere = (result[group]["all"]["psnr"] for result in results)
        assert here == pytest.approx(elsewhere, abs=0.05)
    assert planned(there) == "", "a second call plans nothing"


def show(job: str) -> str:
    """What SLURM says of a job."""
    return subprocess.run(["scontrol", "show", "job", job], capture_output=True, text=True, check=True).stdout


def planned(copy: WorkflowCopy) -> str:
    """The rules that a further call through the profile would run, by its table."""
    done = subprocess.run(
        copy.command("-n", "--workflow-profile", "profiles/slurm", "--", TARGET), cwd=copy.folder,
        capture_output=True, text=True, timeout=PATIENCE_S,
        env={**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": "0"},
    )  # fmt: skip
    return done.stdout.rpartition("Job stats:")[2] if "Job stats:" in done.stdout else ""
