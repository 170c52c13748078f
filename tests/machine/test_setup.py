"""`make setup` and `make doctor` before there is anything: run on a copy with made-up tools, without network."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import REPOSITORY

from drivesplat.machine.doctor.facts import REQUIREMENTS

TOOLS = ("bash", "cat", "cut", "sha256sum", "rm", "grep", "awk", "dirname", "du", "df", "mkdir", "cp", "env", "flock")

PYTHON = """#!/usr/bin/env bash
case "$*" in
  *version_info*) echo "${FAKE_VERSION:-3.11}" ;;
  *"import venv, ensurepip"*) [ -z "${FAKE_NO_VENV:-}" ] ;;
  *_base_executable*) echo "$FAKE_BIN/python3.11" ;;
  --version) echo "Python 3.11.9" ;;
  "-m venv .venv") mkdir -p .venv/bin && cp "$FAKE_BIN/python3.11" .venv/bin/python ;;
  "-m pip check") ;;
  "-m pip "*) echo "pip ${*:3}" >> "$FAKE_LOG"; [ -z "${FAKE_PIP_FAILS:-}" ] ;;
  *torch_builds*) exec "$REAL_PYTHON" "$@" ;;
  *gsplat_build*) echo "gsplat_build ${*:3}" >> "$FAKE_LOG"; exit "${FAKE_BUILD_STATUS:-0}" ;;
  *compileall*) echo "compileall ${*:4}" >> "$FAKE_LOG" ;;
  *warm_up*) echo "warm_up" >> "$FAKE_LOG"; [ -z "${FAKE_WARM_UP_FAILS:-}" ] ;;
  *importlib.metadata*) [ -z "${FAKE_WRONG_TORCH:-}" ] ;;
  *) echo "unexpected: $*" >&2; exit 9 ;;
esac
"""
NVIDIA_SMI = """#!/usr/bin/env bash
echo "$FAKE_GPUS"
"""


class Machine:
    """A copy of what the set-up reads, and a PATH with nothing else than a few tools and made-up programs."""

    def __init__(self, folder: Path):
        self.checkout, self.bin, self.log = folder / "checkout", folder / "bin", folder / "log"
        self.checkout.mkdir()
        self.bin.mkdir()
        shutil.copytree(REPOSITORY / "scripts", self.checkout / "scripts")
        for name in REQUIREMENTS:
            shutil.copy(REPOSITORY / name, self.checkout)
        (self.checkout / "drivesplat").symlink_to(REPOSITORY / "drivesplat")
        for tool in TOOLS:
            (self.bin / tool).symlink_to(shutil.which(tool))
        self.program("python3.11", PYTHON)

    def program(self, name: str, content: str) -> None:
        file = self.bin / name
        file.unlink(missing_ok=True)
        file.write_text(content)
        file.chmod(0o755)

    def gpus(self, *lines: str) -> dict[str, str]:
        self.program("nvidia-smi", NVIDIA_SMI)
        return {"FAKE_GPUS": "\n".join(lines)}

    def run(self, *arguments: str, script: str = "setup", **environment: str) -> subprocess.CompletedProcess:
        known = {
            "PATH": str(self.bin),
            "HOME": str(self.checkout),
            "FAKE_BIN": str(self.bin),
            "FAKE_LOG": str(self.log),
            "REAL_PYTHON": sys.executable,
            "OS_RELEASE": os.devnull,
        }
        command = [self.bin / "bash", f"scripts/{script}.sh", *arguments]
        return subprocess.run(
            command, cwd=self.checkout, env=known | environment, capture_output=True, text=True, check=False
        )

    def done(self) -> list[str]:
        """What was installed and compiled since the last call, a line each."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines

    @property
    def stamp(self) -> Path:
        return self.checkout / ".venv/.made-from"


@pytest.fixture
def machine(tmp_path) -> Machine:
    return Machine(tmp_path)


TURING_OLD_DRIVER = "NVIDIA GeForce RTX 2070, 550.120, 8192, 7900, 7.5"
VOLTA = "Tesla V100-PCIE-16GB, 580.65.06, 16384, 16000, 7.0"
PASCAL = "NVIDIA GeForce GTX 1080 Ti, 580.65.06, 11264, 11000, 6.1"
ADA = "NVIDIA GeForce RTX 4090, 580.65.06, 24564, 24000, 8.9"


def test_a_good_venv_is_left_alone(machine):
    assert machine.run().returncode == 0
    digest = hashlib.sha256()
    for name in REQUIREMENTS:
        digest.update((REPOSITORY / name).read_bytes())
    assert machine.stamp.read_text().strip() == digest.hexdigest()
    done = machine.done()
    made = ["pip", "pip", "pip", "gsplat_build", "compileall", "warm_up", "warm_up"]
    assert [line.split()[0] for line in done] == made
    assert done[2] == "pip install --quiet --no-deps nuscenes-devkit==1.2.0", "whatever numpy it asks for"
    second = machine.run()
    assert second.returncode == 0 and machine.done() == [] and second.stderr == ""


def test_a_machine_that_cannot_train_is_reported_at_once(machine):
    result = machine.run(FAKE_WARM_UP_FAILS="1")
    assert result.returncode == 0, "who has a GPU may do without"
    assert "a first training or world on the processors fails" in result.stderr and "make doctor" in result.stderr
    machine.done()
    assert "a first training" in machine.run(FAKE_WARM_UP_FAILS="1").stderr, "and again, though all packages are there"
    assert [line.split()[0] for line in machine.done()] == ["compileall", "warm_up"]
    assert machine.run().returncode == 0 and [line.split()[0] for line in machine.done()] == [
        "compileall",
        "warm_up",
        "warm_up",
    ]
    assert machine.run().returncode == 0 and machine.done() == []


def test_changed_requirements_remake_it(machine):
    machine.run()
    machine.done()
    with open(machine.checkout / "constraints.txt", "a") as file:
        file.write("# more\n")
    assert machine.run().returncode == 0
    assert any("-r requirements.txt -r requirements-dev.txt -c constraints.txt" in line for line in machine.done())


def test_an_interrupted_installation_is_remade_whole(machine):
    assert machine.run(FAKE_PIP_FAILS="1").returncode != 0
    assert (machine.checkout / ".venv/bin/python").exists() and not machine.stamp.exists()
    (machine.checkout / ".venv/half").touch()
    machine.done()
    assert machine.run().returncode == 0
    assert machine.stamp.exists() and not (machine.checkout / ".venv/half").exists()
    assert any("requirements.txt" in line for line in machine.done())


def test_a_second_setup_in_the_same_checkout_is_refused_and_leaves_the_first_one_alone(machine):
    """pip of the first one runs the second one, and a third when the second has ended."""
    again = 'for run in 2 3; do "$FAKE_BIN/bash" scripts/setup.sh; echo "$run: $?" >&2; done'
    inner = f'  "-m pip install"*) {again} ;;\n'
    case = '  "-m pip check") ;;\n'
    machine.program("python3.11", PYTHON.replace(case, inner + case))
    done = machine.run()
    refused = f"setup: another make setup is at work in {machine.checkout}; wait until it ends"
    said = [line for line in done.stderr.splitlines() if "another" in line or line[1:] == ": 1"]
    assert said == [refused, "2: 1", refused, "3: 1"] * 3, done.stderr
    assert done.returncode == 0 and machine.stamp.exists()
    machine.program("python3.11", PYTHON)
    (machine.bin / "flock").unlink()
    (machine.checkout / "requirements.txt").write_text("torch\n")
    assert machine.run().returncode == 0, "without flock there is no lock"


def test_pip_that_fails_points_to_proxies(machine):
    done = machine.run(FAKE_PIP_FAILS="1")
    assert done.returncode == 1 and "docs/installation.md" in done.stderr and "proxy" in done.stderr


@pytest.mark.parametrize(
    ("release", "expected"),
    [
        ('ID=ubuntu\nVERSION_ID="24.04"\n', "apt-get install python3.12 python3.12-venv python3.12-dev"),
        ('ID=ubuntu\nVERSION_ID="22.04"\n', "apt-get install python3.11 python3.11-venv python3.11-dev"),
        ('ID=debian\nVERSION_ID="12"\n', "apt-get install python3.11 python3.11-venv python3.11-dev"),
        ('ID=debian\nVERSION_ID="13"\n', "apt-get install python3.13 python3.13-venv python3.13-dev"),
        ('ID=ubuntu\nVERSION_ID="26.04"\n', "conda create"),
        ("", "conda create"),
    ],
)
def test_no_suitable_python_names_the_packages_of_the_distribution(machine, tmp_path, release, expected):
    (tmp_path / "os-release").write_text(release)
    machine.program("python3", PYTHON)
    (machine.bin / "python3.11").unlink()
    done = machine.run(FAKE_VERSION="3.14", OS_RELEASE=str(tmp_path / "os-release"))
    assert done.returncode == 1 and expected in done.stderr and "python3 is 3.14" in done.stderr


def test_a_python_of_ones_own_is_taken(machine, tmp_path):
    (machine.bin / "python3.11").rename(tmp_path / "mine")
    assert machine.run().returncode == 1
    machine.program("python3.11", PYTHON.replace("FAKE_VERSION:-3.11", "FAKE_VERSION:-3.9"))
    assert machine.run("--check", PYTHON=str(tmp_path / "mine")).returncode == 0
    done = machine.run("--check", PYTHON=str(tmp_path / "other"))
    assert done.returncode == 1 and f"PYTHON={tmp_path / 'other'}" in done.stderr


def df(free_mb: int) -> str:
    return f"#!/usr/bin/env bash\necho head\necho disk 1 1 {free_mb * 1024} 1% /\n"


@pytest.mark.parametrize(("free_mb", "build", "enough"), [(6500, "", False), (7100, "", True), (3100, "cpu", True)])
def test_too_little_disk_is_refused_before_anything_is_removed(machine, free_mb, build, enough):
    machine.program("df", df(free_mb))
    done = machine.run(TORCH_CUDA=build)
    assert (done.returncode == 0) is enough
    if not enough:
        assert "too little disk" in done.stderr and "7 GB" in done.stderr and "6.5 GB free" in done.stderr
        assert machine.done() == []


@pytest.mark.parametrize(
    ("gpu", "expected"),
    [
        (TURING_OLD_DRIVER, ["driver 550.120", "580", "TORCH_CUDA=cu126 make setup"]),
        (VOLTA, ["Volta", "7.0", "TORCH_CUDA=cu126 make setup"]),
        (PASCAL, ["Pascal", "too old for gsplat", "TORCH_CUDA=cpu make setup"]),
    ],
)
def test_an_unsuitable_gpu_or_driver_stops_before_gigabytes_are_fetched(machine, gpu, expected):
    gpus = machine.gpus(gpu)
    done = machine.run(**gpus)
    assert done.returncode == 1 and machine.done() == []
    assert all(part in done.stderr for part in expected), done.stderr


def test_the_build_asked_for_comes_from_pytorchs_index_and_is_remembered(machine):
    gpus = machine.gpus(VOLTA)
    assert machine.run(TORCH_CUDA="cu126", **gpus).returncode == 0
    lines = machine.done()
    assert (
        "pip install --quiet torch==2.11.0 torchvision==0.26.0 --index-url https://download.pytorch.org/whl/cu126"
        in lines
    )
    assert machine.stamp.read_text().split()[1:] == ["cu126"]
    assert machine.run(**gpus).returncode == 0
    assert not [line for line in machine.done() if line.startswith("pip")], "make test keeps the build"


def test_changed_requirements_keep_the_build_that_was_chosen(machine):
    machine.run(TORCH_CUDA="cpu")
    machine.done()
    (machine.checkout / "requirements.txt").write_text("torch\n")
    assert machine.run().returncode == 0
    assert any("whl/cpu" in line for line in machine.done())


def test_an_index_that_gives_another_torch_is_noticed(machine):
    done = machine.run(TORCH_CUDA="cu126", FAKE_WRONG_TORCH="1")
    assert done.returncode == 1 and "TORCH_INDEX" in done.stderr and not machine.stamp.exists()


def test_an_unsuitable_build_is_made_where_it_was_asked_for(machine):
    done = machine.run(TORCH_CUDA="cu130", **machine.gpus(VOLTA))
    assert done.returncode == 0 and "going on" in done.stderr


def test_an_unknown_build_is_refused_with_those_there_are(machine):
    done = machine.run(TORCH_CUDA="cu118")
    assert done.returncode == 1 and "cu130, cu128, cu126, cpu" in done.stderr and machine.done() == []


def test_gsplat_is_checked_on_every_call_with_a_gpu_or_named_archs(machine):
    machine.run()
    machine.done()
    assert machine.run(GSPLAT_ARCHS="8.6").returncode == 0
    assert machine.done() == ["gsplat_build --if-needed"]
    assert machine.run(**machine.gpus(ADA)).returncode == 0
    assert machine.done() == ["gsplat_build --if-needed"]


def test_gsplat_that_does_not_compile_fails_the_setup_but_not_the_packages(machine):
    done = machine.run(FAKE_BUILD_STATUS="1")
    assert done.returncode == 1 and "GSPLAT_ARCHS=none" in done.stderr
    assert machine.stamp.exists()


def test_the_doctor_without_venv_says_what_stands_in_the_way(machine):
    done = machine.run(script="doctor")
    assert done.returncode == 1 and "make setup" in done.stdout and "nothing stands in the way" in done.stderr
    done = machine.run(script="doctor", FAKE_NO_VENV="1", **machine.gpus(PASCAL))
    assert done.returncode == 1 and "python3.11-venv" in done.stderr
    assert not (machine.checkout / ".venv").exists()


def test_the_doctor_does_not_trust_a_half_made_venv(machine):
    machine.run(FAKE_PIP_FAILS="1")
    done = machine.run(script="doctor")
    assert done.returncode == 1 and "half-made" in done.stdout
