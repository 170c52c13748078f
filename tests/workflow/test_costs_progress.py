"""Progress of a run: finished jobs, trainings that log their share, and the expected rest."""

import logging
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import yaml
from helpers import REPOSITORY
from helpers.patience import wait_until

from drivesplat.settings.config import load
from drivesplat.training import monitor
from drivesplat.workflow.costs.estimate import Expectations, Machine, PlannedJob
from drivesplat.workflow.costs.measured import Cost, JobId
from drivesplat.workflow.costs.progress import RunProgress, watch

CONFIG = load(yaml.safe_load((REPOSITORY / "config.yaml").read_text()))
MASKS, TRAIN = JobId("masks", "0103"), JobId("train", "0103", "street")
FILM = JobId("film", "0103", "street", "original")
COSTS = [Cost(MASKS, 100.0, ""), Cost(TRAIN, 800.0, "", iterations=CONFIG.train.iterations), Cost(FILM, 100.0, "")]
BEGINS = "2026-11-22 00:00:00,000 INFO drivesplat.workflow.job: street/train 0103 begins\n"
AT_HALF = "(iteration 3500 of 7000, loss 0.04, 7 min left)"
LOGGED = "2026-11-22 00:00:10,000 INFO drivesplat.training.monitor: {}\n"


def at(step: int, rest: str) -> str:
    """A line of a training's log."""
    return LOGGED.format(f"iteration {step} of 7000, loss 0.04, {rest}")


def progress(folder: Path, finished: set[JobId], costs: Sequence[Cost] = tuple(COSTS)) -> RunProgress:
    planned = [PlannedJob(job, 1, job is not MASKS) for job in (MASKS, TRAIN, FILM)]
    logs = {job: folder / f"{job.stage}.log" for job in (MASKS, TRAIN, FILM)}
    return RunProgress(lambda: planned, logs, lambda: Expectations(CONFIG, costs), lambda: finished, Machine(1, 1), 0.0)


def test_trainings_weigh_in_proportion_to_their_seconds(tmp_path):
    assert progress(tmp_path, set()).line(0.0) == "0 % of the work, 0 of 3 jobs, about 17 min left"
    assert progress(tmp_path, {MASKS}).line(0.0) == "10 % of the work, 1 of 3 jobs, about 15 min left"
    assert progress(tmp_path, {MASKS, TRAIN}).line(0.0) == "90 % of the work, 2 of 3 jobs, about 2 min left"


def test_a_running_training_reports_its_progress_from_its_first_iteration_on(tmp_path):
    (tmp_path / "train.log").write_text(BEGINS + LOGGED.format("iteration 1 of 120, loss 0.31"))
    line = progress(tmp_path, {MASKS}).line(0.0)
    assert line.endswith("about 15 min left; at work: 0103 street train (iteration 1 of 120, loss 0.31)")
    (tmp_path / "train.log").write_text(BEGINS + at(700, "9 it/s, 999 s left") + at(3500, "18.8 it/s, 400 s left"))
    line = progress(tmp_path, {MASKS}).line(0.0)
    assert line == f"50 % of the work, 1 of 3 jobs, about 8 min left; at work: 0103 street train {AT_HALF}"


def test_jobs_that_were_never_measured_are_counted_and_not_guessed(tmp_path):
    """A running training says how long it still takes."""
    alone = progress(tmp_path, {MASKS}, costs=COSTS[:1])
    assert alone.line(0.0) == "1 of 3 jobs done"
    (tmp_path / "train.log").write_text(BEGINS + at(3500, "18.8 it/s, 400 s left"))
    line = alone.line(0.0)
    assert line == (
        f"1 of 3 jobs, about 7 min left without 1 job whose time is not known yet; at work: 0103 street train {AT_HALF}"
    )


def test_a_training_logs_what_progress_reads(tmp_path, monkeypatch, caplog):
    now = [60.0]
    monkeypatch.setattr(monitor.time, "monotonic", lambda: now[0])
    watched = monitor.Monitor(tmp_path / "tensorboard", iterations=1000, start=40, label="x")
    read = []
    with caplog.at_level(logging.INFO, logger="drivesplat.training.monitor"):
        for step, now[0] in ((41, 60.0), (100, 65.0), (200, 69.9), (281, 72.0), (350, 73.0), (401, 84.0)):
            watched.progress(step, Terms(read, {"l1": torch.tensor(0.25), "ssim": torch.tensor(0.5)}))
    monkeypatch.undo()
    watched.close()
    assert [record.message for record in caplog.records] == [
        "iteration 41 of 1000, loss 0.75",
        "iteration 281 of 1000, loss 0.75, 20 it/s, 36 s left",
        "iteration 401 of 1000, loss 0.75, 10 it/s, 60 s left",
    ]
    assert len(read) == 3, "other iterations do not wait for the device"
    (tmp_path / "train.log").write_text(BEGINS + LOGGED.format(caplog.records[-1].message))
    assert "train (iteration 401 of 1000, loss 0.75, 60 s left)" in progress(tmp_path, {MASKS}).line(0.0)


class Terms(dict):
    """Loss terms that note when they are read."""

    def __init__(self, read: list, terms: dict):
        super().__init__(terms)
        self._read = read

    def values(self):
        self._read.append(1)
        return super().values()


@pytest.mark.parametrize("fails", [False, True])
def test_a_watch_prints_and_outlives_what_goes_wrong(tmp_path, capsys, fails):
    finished = set() if not fails else None
    ended = watch(progress(tmp_path, finished), every_s=0.01)
    printed: list[str] = []
    wait_until(lambda: printed.append(capsys.readouterr().err) or "".join(printed).count("drivesplat: ") >= 2)
    ended.set()
    assert ("the progress of the run is unknown" if fails else "0 % of the work") in "".join(printed)
