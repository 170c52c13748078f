"""The number of visible GPUs, and the GPU of each job: one job per GPU, and each job sees only its own."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers import REPOSITORY
from helpers.patience import PATIENCE_S

from drivesplat.workflow.job import Job
from drivesplat.settings.device import DeviceSettings
from drivesplat.workflow.gpus import visible_gpus

VARIABLES = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES")


@pytest.fixture
def four_gpus(monkeypatch):
    """A machine with four NVIDIA GPUs, all visible."""
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    devices = [Path(f"/dev/nvidia{i}") for i in range(4)] + [Path("/dev/nvidiactl"), Path("/dev/nvidia-uvm")]
    with_gpus = {Path("/dev"): devices, Path("/sys/class/kfd/kfd/topology/nodes"): []}
    real = Path.glob
    monkeypatch.setattr(
        Path, "glob", lambda self, *a, **k: iter(with_gpus[self]) if self in with_gpus else real(self, *a, **k)
    )


def test_all_gpus_count_where_none_is_hidden(four_gpus):
    assert visible_gpus() == 4


@pytest.mark.parametrize("variable", VARIABLES)
def test_hidden_gpus_do_not_count_and_there_is_always_one(four_gpus, monkeypatch, variable):
    lists = {"0": 1, "2,3": 2, "0,1,2": 3, "GPU-5a3c,GPU-77de": 2, "MIG-1f0e": 1, "-1": 1, " 0 , 1 ": 2}
    if variable == "CUDA_VISIBLE_DEVICES":
        lists[""] = 1
    for value, gpus in lists.items():
        monkeypatch.setenv(variable, value)
        assert visible_gpus() == gpus, value


def test_amd_gpus_count_processors_do_not_and_without_any_there_is_one(four_gpus, monkeypatch, tmp_path):
    nodes = []
    for node, gpu_id in enumerate(("0", "0", "51234", "8121")):
        nodes.append(tmp_path / str(node) / "gpu_id")
        nodes[-1].parent.mkdir()
        nodes[-1].write_text(f"{gpu_id}\n")
    for found, gpus in ((nodes, 2), ([], 1)):
        at_place = {Path("/dev"): [], Path("/sys/class/kfd/kfd/topology/nodes"): found}
        monkeypatch.setattr(Path, "glob", lambda self, *_, there=at_place: iter(there[self]))
        assert visible_gpus() == gpus


HOLD = """
import logging, os, sys, time
from drivesplat.workflow.gpus import hold_gpu
logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
lock = hold_gpu(int(sys.argv[1]))
print("holds", os.environ.get("CUDA_VISIBLE_DEVICES"), flush=True)
time.sleep(float(sys.argv[2]))
"""


class Machine:
    """A machine with GPUs, a folder for locks, and an nvidia-smi that lists `uuids` as the GPUs of a job."""

    def __init__(self, folder: Path, uuids: list[str] | None = None):
        self.folder = folder
        for name in ("bin", "tmp"):
            (folder / name).mkdir()
        self.set_uuids(uuids)
        self.jobs: list[subprocess.Popen] = []

    def set_uuids(self, uuids: list[str] | None) -> None:
        program = self.folder / "bin/nvidia-smi"
        lines = "".join(f"echo '{index}, {uuid}'\n" for index, uuid in enumerate(uuids or []))
        program.write_text(f"#!/bin/sh\n{lines}" if uuids else "#!/bin/sh\nexit 9\n")
        program.chmod(0o755)

    def start(self, visible: str | None, jobs_per_card: int = 1) -> subprocess.Popen:
        """A job that holds a GPU until it is killed."""
        path = f"{self.folder / 'bin'}:{os.environ['PATH']}"
        environment = {k: v for k, v in os.environ.items() if not k.endswith("_VISIBLE_DEVICES")}
        environment |= {"PATH": path, "TMPDIR": str(self.folder / "tmp"), "PYTHONPATH": str(REPOSITORY)}
        if visible is not None:
            environment["CUDA_VISIBLE_DEVICES"] = visible
        job = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(jobs_per_card), str(PATIENCE_S)],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        self.jobs.append(job)
        return job

    def gpu_of(self, job: subprocess.Popen) -> str:
        """The GPU that a job sees once it holds it."""
        for line in job.stdout:
            if line.startswith("holds "):
                return line.split()[1]
        raise AssertionError(job.wait())

    def gpus_of(self, visible: str | None, jobs: int, jobs_per_card: int = 1) -> list[str]:
        return [self.gpu_of(job) for job in [self.start(visible, jobs_per_card) for _ in range(jobs)]]


@pytest.fixture
def machine(tmp_path):
    machine = Machine(tmp_path, ["GPU-a", "GPU-b", "GPU-c", "GPU-d"])
    yield machine
    for job in machine.jobs:
        job.kill()
        job.wait()
        job.stdout.close()


@pytest.mark.parametrize("visible", ["0,1", "GPU-b,GPU-d"])
def test_jobs_started_at_the_same_time_see_a_gpu_each(machine, visible):
    gpus = visible.split(",")
    assert sorted(machine.gpus_of(visible, len(gpus))) == gpus


def test_one_more_job_waits_with_a_warning_and_gets_the_gpu_of_a_killed_one(machine):
    holders = [machine.start("0,1") for _ in range(2)]
    gpus = [machine.gpu_of(job) for job in holders]
    late = machine.start("0,1")
    line = late.stdout.readline()
    assert line.startswith("waits for a GPU") and all(str(job.pid) in line for job in holders), line
    assert "device.jobs_per_card" in line
    holders[1].send_signal(signal.SIGKILL)
    assert machine.gpu_of(late) == gpus[1]


def test_more_jobs_share_the_gpus_evenly_where_they_may(machine):
    assert sorted(machine.gpus_of("0,1", 4, jobs_per_card=2)) == ["0", "0", "1", "1"]


def test_gpus_that_a_scheduler_shows_each_as_number_0_are_distinguished(machine):
    machine.set_uuids(["GPU-c"])
    first = machine.gpus_of("0", 1)
    machine.set_uuids(["GPU-d"])
    assert first == machine.gpus_of("0", 1) == ["0"]


def test_a_single_gpu_of_unknown_identity_from_a_scheduler_is_used_as_given(machine):
    machine.set_uuids(None)
    assert machine.gpus_of("0", 2) == ["0", "0"]
    assert sorted(machine.gpus_of("0,1", 2)) == ["0", "1"]


@pytest.mark.parametrize("visible", ["", "-1"])
def test_without_gpus_nothing_is_held_and_nothing_changed(machine, visible):
    assert machine.start(visible).stdout.readline() == f"holds {visible}\n"


def test_locks_that_cannot_be_written_are_named(machine):
    (machine.folder / f"tmp/drivesplat-cards-{os.getuid()}").write_text("a file")
    output = machine.start("0,1").communicate(timeout=PATIENCE_S)[0].strip().splitlines()[-1]
    assert output.startswith("drivesplat.errors.DeviceError") and "TMPDIR" in output and "GPU-a.0" in output


@pytest.mark.parametrize("kind", ["auto", "any", "cuda"])
def test_a_rules_job_holds_a_gpu_from_the_choice_of_its_device(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("it waits for itself"))
    jobs = [rules_job(kind) for _ in range(2)]
    for job, gpu in zip(jobs, ("GPU-x", "GPU-y"), strict=True):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-x,GPU-y")
        for _ in ("once", "again"):
            assert job.device().kind == kind
            assert os.environ["CUDA_VISIBLE_DEVICES"] == gpu


def test_a_rules_job_on_the_cpu_holds_none(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-x,GPU-y")
    rules_job("cpu").device()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "GPU-x,GPU-y" and not list(tmp_path.iterdir())


def rules_job(kind: str) -> Job:
    resources = SimpleNamespace(device=DeviceSettings(kind=kind).model_dump_json())
    nothing = dict.fromkeys(("log", "wildcards", "threads", "rule", "params"))
    return Job(SimpleNamespace(**nothing, input=[], output=[], resources=resources))
