"""Runs that are killed, and what they leave: the next run needs no flags, and no training runs twice."""

import os
import signal
import subprocess
from collections.abc import Iterator
from functools import partial

import pytest
from helpers.killed_runs import only_complaint, training_process
from helpers.patience import PATIENCE_S, wait_until
from helpers.shared_runs import VANILLA
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("killed")]

TARGET = "results/0001/vanilla/train.json"


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Iterator[WorkflowCopy]:
    """A workflow whose training lasts longer than any test."""
    endless = TINY_TRAINING | {"iterations": 200_000, "checkpoint_every": 10}
    made = WorkflowCopy.make(tmp_path_factory.mktemp("killed") / "workflow", methods=VANILLA, train=endless)
    yield made
    trainer = training_process(made)
    if trainer is not None:
        os.kill(trainer, signal.SIGKILL)


def started(copy: WorkflowCopy) -> subprocess.Popen:
    """Snakemake at work on the training, in a session of its own, which SIGINT ends even where these tests run in the
    background of a shell that ignores it."""
    return subprocess.Popen(
        copy.command("--cores", "2", "--", TARGET), cwd=copy.folder, env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def at_work(copy: WorkflowCopy) -> subprocess.Popen:
    """The same, once it has written a resume state."""
    state = copy.folder / "results/0001/vanilla/resume/state.npz"
    state.unlink(missing_ok=True)
    running = started(copy)
    wait_until(state.exists)
    return running


@pytest.mark.slow
def test_a_training_that_outlives_a_killed_run_is_named_and_never_doubled(copy):
    running = at_work(copy)
    running.kill()
    running.wait()
    orphan = training_process(copy)
    assert orphan is not None, "the training goes on"
    line = only_complaint(copy.run(TARGET))
    assert f"process {orphan} is still training" in line and f"kill {orphan}" in line
    assert training_process(copy) == orphan
    os.kill(orphan, signal.SIGKILL)
    wait_until(lambda: training_process(copy) is None)
    done = copy.run("results/0001/parser.pkl")
    assert done.returncode == 0 and "Nothing to be done" in done.stdout, "no lock is left, and nothing is broken"


@pytest.mark.slow
def test_an_interrupted_run_takes_its_training_along_and_the_next_one_goes_on(copy):
    running = at_work(copy)
    assert "another run is working in results/" in only_complaint(copy.run("report")), (
        "meanwhile there is no second one"
    )
    os.killpg(running.pid, signal.SIGINT)
    assert running.wait(PATIENCE_S) != 0
    wait_until(lambda: training_process(copy) is None)
    folder = copy.folder / "results/0001/vanilla"
    assert not (folder / "checkpoint.npz").exists() and (folder / "resume/state.npz").exists()
    log = copy.folder / "results/logs/0001/vanilla/train.log"
    log.unlink()
    again = started(copy)
    try:
        wait_until(lambda: log.exists() and "resuming at iteration" in log.read_text())
    finally:
        os.killpg(again.pid, signal.SIGINT)
        again.wait(PATIENCE_S)
