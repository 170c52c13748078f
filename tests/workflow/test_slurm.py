"""The workflow through a real SLURM: its profile, and that results are those of a local run. `make test-slurm`"""

import os
import re
import shutil
import subprocess

import pytest
import yaml
from helpers.drives import World
from helpers.patience import PATIENCE_S
from helpers.shared_runs import VANILLA
from helpers.workflow_copy import REPOSITORY, TINY_TRAINING, WorkflowCopy

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


on_slurm = pytest.mark.skipif(shutil.which("sinfo") is None, reason="no SLURM here: make test-slurm")


@pytest.mark.slurm
@on_slurm
def test_a_scene_through_slurm_comes_out_as_one_that_runs_here(tmp_path):
    copies = {name: WorkflowCopy.make(tmp_path / name, methods={"vanilla": {}}) for name in ("here", "there")}
    assert copies["here"].run(TARGET).returncode == 0
    there = with_gpus_of_slurm(copies["there"])
    with through_slurm(there) as run:
        said = run.stdout.read()
    assert run.returncode == 0, said
    jobs = re.findall(r"submitted with SLURM jobid (\d+) \(log: \S*/rule_(\w+)/", said)
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


@pytest.mark.slurm
@on_slurm
def test_blocks_of_a_drive_go_on_where_the_training_of_one_is_cancelled(tmp_path):
    """Snakemake then trains that block again, and no other."""
    blocks = {"dataroot": "data", "scenes": ["0001"], "blocks": {"length_m": 30.0, "overlap_m": 10.0}}
    copy = WorkflowCopy.make(
        tmp_path, World(speed=10.0, key_frames=16), datasets={"nuscenes": blocks}, methods=VANILLA,
        holdout={"every_nth": 5, "offset": 2, "last_block": 1}, train={**TINY_TRAINING, "iterations": 20},
    )  # fmt: skip
    with_gpus_of_slurm(copy)
    lines = []
    with through_slurm(copy, "--keep-going") as run:
        for line in run.stdout:
            lines.append(line)
            if job := re.search(r"SLURM jobid (\d+) \(log: \S*/rule_train/\S*0001\.001", line):
                subprocess.run(["scancel", job[1]], check=True)
    said = "".join(lines)
    assert run.returncode and "blocks failed or were interrupted: 0001.001 (" in said, said
    checkpoints = [copy.folder / f"results/0001.00{number}/vanilla/checkpoint.npz" for number in range(3)]
    assert [path.is_file() for path in checkpoints] == [True, False, True]
    before = [checkpoints[number].stat().st_mtime_ns for number in (0, 2)]
    with through_slurm(copy) as run:
        said = run.stdout.read()
    assert run.returncode == 0, said
    assert [checkpoints[number].stat().st_mtime_ns for number in (0, 2)] == before and checkpoints[1].is_file()
    assert len(copy.read(TARGET)["methods"]["vanilla"]["blocks"]) == 3
    assert planned(copy) == "", "a further call plans nothing"


def with_gpus_of_slurm(copy: WorkflowCopy) -> WorkflowCopy:
    """The copy for a SLURM whose GPUs do not exist."""
    copy.config["device"] = "any"
    copy.write_config()
    return copy


def through_slurm(copy: WorkflowCopy, *flags: str) -> subprocess.Popen[str]:
    """A run of TARGET through SLURM that has begun."""
    return subprocess.Popen(
        copy.command(*ON_SLURM, *flags, "--", TARGET), cwd=copy.folder, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, env={**os.environ, "PYTHONPATH": "", "CUDA_VISIBLE_DEVICES": "0"},
    )  # fmt: skip


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
