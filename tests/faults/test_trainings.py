"""What befalls trainings: killed while they write, resumed by another, without room on the disk, without numbers."""

import errno
import logging
import math
import os
import resource
import shutil
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.patience import PATIENCE_S
from helpers.trainings import (
    PROVENANCE,
    EndedError,
    files_in,
    in_subprocess,
    inputs_in,
    job_of,
    settings_of,
    trained,
    untrained,
)

from drivesplat.workflow.job import job
from drivesplat.errors import ResultError, TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.model.checkpoint import STATE, UNFINISHED, TrainedCheckpoint, read_snapshot, trained_model
from drivesplat.settings.device import DeviceSettings
from drivesplat.training.loop import TrainingFolders
from drivesplat.training.monitor import Monitor
from drivesplat.training.resume_state import resumable
from drivesplat.training.stage import run_training

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = DeviceSettings(kind="cpu")
RESUMABLE = job_of(iterations=20, checkpoint_every=10)


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory) -> Path:
    """A folder with a training that has ended before it wrote its result."""
    folder = tmp_path_factory.mktemp("interrupted")

    def ended(path: Path, checkpoint: TrainedCheckpoint) -> None:
        raise EndedError

    with pytest.MonkeyPatch.context() as patched, pytest.raises(EndedError):
        patched.setattr("drivesplat.training.stage.write_checkpoint", ended)
        run_training(inputs_in(folder), RESUMABLE, CPU, files_in(folder / "it"), PROVENANCE, "train")
    return folder


@pytest.mark.parametrize("other", ["settings_sha256", "code_sha256", "inputs_sha256", None])
def test_only_the_same_settings_code_and_inputs_resume(interrupted, caplog, monkeypatch, other):
    """The digests of a training's provenance are what tells its resume state from another's."""
    files = files_in(interrupted / "it")

    def begun(*arguments: Any, **_: Any) -> None:
        (folders,) = (given for given in arguments if isinstance(given, TrainingFolders))
        found = resumable(folders.state, folders.fingerprint)
        assert (found and found["step"]) == (None if other else 10)
        raise EndedError

    monkeypatch.setattr("drivesplat.training.stage.train", begun)
    with caplog.at_level(logging.INFO), pytest.raises(EndedError):
        provenance = {**PROVENANCE, **({other: "other"} if other else {})}
        run_training(inputs_in(interrupted), RESUMABLE, CPU, files, provenance, "train")
    ignored = f"{files.resume / 'state.npz'} belongs to other settings, code or inputs: training starts at 0"
    assert (ignored in caplog.text) == (other is not None)


def test_the_model_of_an_unfinished_training_can_be_looked_at(interrupted, tmp_path):
    """Rows that were preallocated at the end of a part's parameters are no Gaussians."""
    resume = files_in(interrupted / "it").resume
    saved = checkpoint_file.load(resume / STATE, "train")
    found = trained_model(read_snapshot(resume)).state_dict()
    assert found.keys() == saved["state"]["model"].keys()
    assert all(torch.equal(found[name], values) for name, values in saved["state"]["model"].items())
    folder = tmp_path / "resume"
    shutil.copytree(resume, folder)
    saved["state"]["preallocated"] = [3, *[0] * (len(saved["state"]["preallocated"]) - 1)]
    checkpoint_file.save(folder / STATE, saved)
    fewer = trained_model(read_snapshot(folder))
    assert len(fewer.parts[0]) == len(saved["state"]["model"]["parts.0.params.means"]) - 3
    (folder / UNFINISHED).unlink()
    with pytest.raises(ResultError, match=UNFINISHED):
        read_snapshot(folder)


def train_and_kill_the_parent(folder: str) -> None:
    """For a subprocess: a training in a process of its own, which ends its parent, as by `kill -9`, once there is a
    checkpoint, and itself comes to its end."""
    torch.set_num_threads(1)
    if os.fork():
        signal.pause()
    save, parent = checkpoint_file.save, os.getppid()

    def save_and_kill(path: Path, content: dict[str, Any]) -> None:
        save(path, content)
        with suppress(ProcessLookupError):
            os.kill(parent, signal.SIGKILL)
        while os.getppid() == parent:  # a killed process has children until all its memory is given back
            time.sleep(0.01)

    checkpoint_file.save = save_and_kill
    run_training(inputs_in(Path(folder)), RESUMABLE, CPU, files_in(Path(folder) / "it"), PROVENANCE, "train")


@pytest.mark.slow
def test_a_training_whose_end_snakemake_missed_resumes_from_its_last_checkpoint(tmp_path, caplog):
    process, files = in_subprocess(train_and_kill_the_parent, str(tmp_path)), files_in(tmp_path / "it")
    _, errors = process.communicate(timeout=PATIENCE_S)  # as long as any of both is there
    assert process.returncode == -signal.SIGKILL and files.summary.is_file(), errors
    for output in (files.checkpoint, files.summary):
        output.unlink()  # as Snakemake does, which takes them for half made
    with caplog.at_level(logging.INFO):
        run_training(inputs_in(tmp_path), RESUMABLE, CPU, files, PROVENANCE, "train")
    assert "resuming at iteration 10 of 20" in caplog.text
    assert files.summary.is_file() and not files.resume.exists()


def test_a_gradient_that_is_no_number_stops_a_training_whose_losses_are_numbers(tmp_path):
    settings = settings_of(checkpoint_every=2, log_every=1, refine_start=1.0)
    model = untrained(settings)
    calls = iter(range(1, 1000))
    model.parts[0].params["quats"].register_hook(lambda g: g * math.nan if next(calls) == 4 else g)
    with pytest.raises(TrainingError) as error:
        trained(tmp_path, settings, model=model)
    message = str(error.value)
    assert message.startswith("iteration 4: gradient of background quats is not finite;") and "loss" not in message
    kept = checkpoint_file.load(tmp_path / "resume/state.npz", "train")
    assert kept["step"] == 2
    assert all(torch.isfinite(value).all() for value in kept["state"]["model"].values())


class FullDisk:
    """So many bytes a file, no more, as on a disk without room: the same write fails in the same place."""

    def __init__(self, size: int):
        self.size = size

    def __enter__(self) -> None:
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, self.before[1]))

    def __exit__(self, *_: object) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)


@pytest.fixture
def quiet_threads(monkeypatch):
    """TensorBoard writes in a thread, which fails as well: what it says is no part of this."""
    monkeypatch.setattr(threading, "excepthook", lambda _: None)


@pytest.mark.parametrize(("size", "named"), [(0, "resume"), (16, "tensorboard"), (8192, "state.npz")])
def test_a_training_on_a_full_disk_names_what_it_could_not_write(tmp_path, quiet_threads, size, named):
    """And leaves no file that could pass for a result."""
    files, inputs = files_in(tmp_path / "vanilla"), inputs_in(tmp_path)
    with FullDisk(size), pytest.raises(ResultError, match=rf"{named}: cannot be written .*; free space or fix its"):
        run_training(inputs, job_of(checkpoint_every=5), CPU, files, PROVENANCE, "train")
    left = {path.name for path in files.checkpoint.parent.rglob("*") if path.is_file()}
    assert all(name == "lock" or name.startswith("events.") for name in left)


def test_the_cause_of_a_failed_training_takes_precedence_over_a_full_disk(tmp_path, quiet_threads):
    monitor = Monitor(tmp_path, 10, 0, "x")
    with FullDisk(0), pytest.raises(EndedError), monitor:
        monitor.scalars(1, {"loss/total": 1.0, "gaussians": 5.0}, 1)
        raise EndedError


def ended_by(tmp_path: Path, error: Exception | None, capsys: pytest.CaptureFixture) -> tuple[str, str]:
    """What a rule's script that raises `error` says on the console, and what its log holds."""
    root = logging.getLogger()
    before = root.handlers[:], root.level, logging.raiseExceptions, threading.excepthook
    nothing = {"input": [], "output": [], "threads": 1, "params": None, "resources": None}
    place = {"rule": "film", "wildcards": SimpleNamespace(scene="0001"), "log": [str(tmp_path / "logs/x.log")]}
    try:
        with pytest.raises(SystemExit) as ended, job(SimpleNamespace(**nothing, **place)):
            raise error
        assert ended.value.code == 1
    finally:
        root.handlers[:], root.level, logging.raiseExceptions, threading.excepthook = before
        logging.captureWarnings(False)
    return capsys.readouterr().err, (tmp_path / "logs/x.log").read_text()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_full_disk_is_not_reported_as_a_bug(tmp_path, capsys, number):
    printed, logged = ended_by(tmp_path, OSError(number, os.strerror(number), "frames/000001.png"), capsys)
    expected = (
        f"film 0001: frames/000001.png: cannot be written ({os.strerror(number)}); free space or fix its permissions"
    )
    assert printed == f"drivesplat: {expected}\n"
    assert logged.splitlines()[-1].endswith(f"ERROR drivesplat.workflow.job: {expected}") and "Traceback" not in logged


def test_any_other_error_is_one_with_its_traceback_in_the_log(tmp_path, capsys):
    printed, logged = ended_by(tmp_path, FileNotFoundError(errno.ENOENT, "No such file", "x"), capsys)
    assert printed.count("\n") == 1 and "(a bug; the traceback is in" in printed and "x.log)" in printed
    assert "Traceback" in logged and logged.splitlines()[-1].endswith(printed.strip().removeprefix("drivesplat: "))


def test_a_disk_too_full_for_the_log_is_reported_once(tmp_path, capsys):
    with FullDisk(0):
        printed, logged = ended_by(tmp_path, ResultError("x.mp4: cannot be written (No space left on device)"), capsys)
    assert printed == "drivesplat: film 0001: x.mp4: cannot be written (No space left on device)\n" and logged == ""
