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
  *"--no-deps -e .") echo "command" >> "$FAKE_LOG"
     [ -z "${FAKE_NO_COMMAND:-}" ] && cp "$FAKE_BIN/python3.11" .venv/bin/drivesplat ;;
  "-m pip "*) echo "pip ${*:3}" >> "$FAKE_LOG"; [ -z "${FAKE_PIP_FAILS:-}" ] ;;
  *torch_builds*) exec "$REAL_PYTHON" "$@" ;;
  *gsplat_build*) echo "gsplat_build ${*:3}" >> "$FAKE_LOG"; exit "${FAKE_BUILD_STATUS:-0}" ;;
  *compileall*) echo "compileall ${*:4}" >> "$FAKE_LOG" ;;
  "-m drivesplat.cli setup "*) echo "kernels ${*:4}" >> "$FAKE_LOG"; [ -z "${FAKE_KERNELS_FAIL:-}" ] ;;
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
            "PATH": str(self.bin), "HOME": str(self.checkout), "FAKE_BIN": str(self.bin), "FAKE_LOG": str(self.log),
            "REAL_PYTHON": sys.executable, "OS_RELEASE": os.devnull,
        }  # fmt: skip
        command = [self.bin / "bash", f"scripts/{script}.sh", *arguments]
        return subprocess.run(
            command, cwd=self.checkout, env=known | environment, capture_output=True, text=True, check=False
        )

    def done(self) -> list[str]:
        """What was installed and compiled since the last call, a line each."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines

    def begun(self) -> list[str]:
        """The first word of each of those lines."""
        return [line.split()[0] for line in self.done()]

    @property
    def stamp(self) -> Path:
        return self.checkout / ".venv/.made-from"


@pytest.fixture
def machine(tmp_path) -> Machine:
    return Machine(tmp_path)


VOLTA = "Tesla V100-PCIE-16GB, 580.65.06, 16384, 16000, 7.0"
ADA = "NVIDIA GeForce RTX 4090, 580.65.06, 24564, 24000, 8.9"


def test_a_good_venv_is_left_alone_and_remade_for_other_requirements(machine):
    """Gsplat is checked on every call with a GPU or with named architectures."""
    assert machine.run().returncode == 0
    digest = hashlib.sha256(b"".join((REPOSITORY / name).read_bytes() for name in REQUIREMENTS)).hexdigest()
    assert machine.stamp.read_text().strip() == digest
    done = machine.done()
    made = ["pip", "pip", "pip", "command", "gsplat_build", "compileall", "warm_up", "warm_up"]
    assert [line.split()[0] for line in done] == made
    assert done[2] == "pip install --quiet --no-deps nuscenes-devkit==1.2.0", "whatever numpy it asks for"
    second = machine.run()
    assert second.returncode == 0 and machine.done() == [] and second.stderr == ""
    assert machine.run(GSPLAT_ARCHS="8.6").returncode == 0
    assert machine.done() == ["gsplat_build --if-needed", "kernels --arch 8.6"]
    assert machine.run(**machine.gpus(ADA)).returncode == 0
    assert machine.done() == ["gsplat_build --if-needed", "kernels --gpu-kernels"]
    with open(machine.checkout / "constraints.txt", "a") as file:
        file.write("# more\n")
    assert machine.run().returncode == 0
    assert any("-r requirements.txt -r requirements-dev.txt -c constraints.txt" in line for line in machine.done())


def test_who_cannot_install_the_command_goes_without_it_and_it_is_tried_again(machine):
    failed = machine.run(FAKE_NO_COMMAND="1")
    assert failed.returncode == 0 and "python -m drivesplat.cli" in failed.stderr and machine.stamp.exists()
    machine.done()
    assert machine.run().returncode == 0 and machine.done() == ["command"]


def test_a_machine_that_cannot_train_is_reported_on_every_call(machine):
    for begun in (["pip", "pip", "pip", "command", "gsplat_build", "compileall", "warm_up"], ["compileall", "warm_up"]):
        result = machine.run(FAKE_WARM_UP_FAILS="1")
        assert result.returncode == 0 and machine.begun() == begun, "who has a GPU may do without"
        assert "a first training or world on the processors fails" in result.stderr and "make doctor" in result.stderr
    assert machine.run().returncode == 0 and machine.begun() == ["compileall", "warm_up", "warm_up"]


def test_a_card_whose_kernels_cannot_be_compiled_beforehand_does_not_stop_the_setup(machine):
    result = machine.run(FAKE_KERNELS_FAIL="1", **machine.gpus(ADA))
    assert result.returncode == 0 and "the first jobs on a GPU compile its kernels" in result.stderr


def test_an_interrupted_installation_is_not_trusted_and_remade_whole(machine):
    failed = machine.run(FAKE_PIP_FAILS="1")
    assert failed.returncode == 1 and "docs/installation.md" in failed.stderr and "proxy" in failed.stderr
    assert (machine.checkout / ".venv/bin/python").exists() and not machine.stamp.exists()
    doctor = machine.run(script="doctor")
    assert doctor.returncode == 1 and "half-made" in doctor.stdout
    (machine.checkout / ".venv/half").touch()
    machine.done()
    assert machine.run().returncode == 0
    assert machine.stamp.exists() and not (machine.checkout / ".venv/half").exists()
    assert any("requirements.txt" in line for line in machine.done())


def test_a_second_setup_in_the_same_checkout_is_refused_and_leaves_the_first_one_alone(machine):
    """The first call of pip runs a second one, and a third when the second has ended."""
    again = 'for run in 2 3; do "$FAKE_BIN/bash" scripts/setup.sh; echo "$run: $?" >&2; done'
    inner = f'  "-m pip install --quiet --upgrade pip") {again} ;;\n'
    case = '  "-m pip check") ;;\n'
    machine.program("python3.11", PYTHON.replace(case, inner + case))
    done = machine.run()
    refused = f"setup: another make setup is at work in {machine.checkout}; wait until it ends"
    said = [line for line in done.stderr.splitlines() if "another" in line or line[1:] == ": 1"]
    assert said == [refused, "2: 1", refused, "3: 1"], done.stderr
    assert done.returncode == 0 and machine.stamp.exists()
    machine.program("python3.11", PYTHON)
    (machine.bin / "flock").unlink()
    (machine.checkout / "requirements.txt").write_text("torch\n")
    assert machine.run().returncode == 0, "without flock there is no lock"


def test_no_suitable_python_names_the_packages_of_the_distribution(machine, tmp_path):
    machine.program("python3", PYTHON)
    (machine.bin / "python3.11").unlink()
    for identity, version, expected in (
        ("ubuntu", "24.04", "apt-get install python3.12 python3.12-venv python3.12-dev"),
        ("ubuntu", "22.04", "apt-get install python3.11 python3.11-venv python3.11-dev"),
        ("debian", "12", "apt-get install python3.11 python3.11-venv python3.11-dev"),
        ("debian", "13", "apt-get install python3.13 python3.13-venv python3.13-dev"),
        ("ubuntu", "26.04", "conda create"),
    ):
        (tmp_path / "os-release").write_text(f'ID={identity}\nVERSION_ID="{version}"\n')
        done = machine.run(FAKE_VERSION="3.14", OS_RELEASE=str(tmp_path / "os-release"))
        assert done.returncode == 1 and expected in done.stderr and "python3 is 3.14" in done.stderr


def test_a_python_of_ones_own_is_taken(machine, tmp_path):
    (machine.bin / "python3.11").rename(tmp_path / "mine")
    assert machine.run().returncode == 1
    machine.program("python3.11", PYTHON.replace("FAKE_VERSION:-3.11", "FAKE_VERSION:-3.9"))
    assert machine.run("--check", PYTHON=str(tmp_path / "mine")).returncode == 0
    done = machine.run("--check", PYTHON=str(tmp_path / "other"))
    assert done.returncode == 1 and f"PYTHON={tmp_path / 'other'}" in done.stderr


CHECK = ("--check",)


def test_too_little_disk_is_refused_before_anything_is_removed(machine):
    for free_mb, build, arguments, enough in (
        (6500, "", (), False),
        (7100, "", CHECK, True),
        (3100, "cpu", CHECK, True),
    ):
        df = f"#!/usr/bin/env bash\necho head\necho disk 1 1 {free_mb * 1024} 1% /\n"
        machine.program("df", df)
        done = machine.run(*arguments, TORCH_CUDA=build)
        assert (done.returncode == 0) is enough and machine.done() == []
        if not enough:
            assert "too little disk" in done.stderr and "7 GB" in done.stderr and "6.5 GB free" in done.stderr


def test_a_build_for_another_gpu_is_refused_and_one_asked_for_is_made_and_remembered(machine):
    """Before gigabytes are fetched. The reasons for each GPU and driver are those of the doctor."""
    gpus = machine.gpus(VOLTA)
    refused, unknown = machine.run(**gpus), machine.run(TORCH_CUDA="cu118")
    assert refused.returncode == unknown.returncode == 1 and machine.done() == []
    assert all(part in refused.stderr for part in ("Volta", "7.0", "TORCH_CUDA=cu126 make setup"))
    assert "cu130, cu128, cu126, cpu" in unknown.stderr
    wrong = machine.run(TORCH_CUDA="cu126", FAKE_WRONG_TORCH="1", **gpus)
    assert wrong.returncode == 1 and "TORCH_INDEX" in wrong.stderr and not machine.stamp.exists()
    machine.done()
    assert machine.run(TORCH_CUDA="cu126", **gpus).returncode == 0
    index = "--index-url https://download.pytorch.org/whl/cu126"
    assert f"pip install --quiet torch==2.11.0 torchvision==0.26.0 {index}" in machine.done()
    assert machine.stamp.read_text().split()[1:] == ["cu126"]
    assert machine.run(**gpus).returncode == 0 and "pip" not in machine.begun(), "make test keeps the build"
    (machine.checkout / "requirements.txt").write_text("torch\n")
    assert machine.run(**gpus).returncode == 0 and any("whl/cu126" in line for line in machine.done())
    unsuitable = machine.run(TORCH_CUDA="cu130", **gpus)
    assert unsuitable.returncode == 0 and "going on" in unsuitable.stderr


def test_gsplat_that_does_not_compile_fails_the_setup_but_not_the_packages(machine):
    done = machine.run(FAKE_BUILD_STATUS="1")
    assert done.returncode == 1 and "GSPLAT_ARCHS=none" in done.stderr
    assert machine.stamp.exists()


def test_the_doctor_without_venv_says_what_stands_in_the_way(machine):
    done = machine.run(script="doctor")
    assert done.returncode == 1 and "make setup" in done.stdout and "nothing stands in the way" in done.stderr
    done = machine.run(script="doctor", FAKE_NO_VENV="1")
    assert done.returncode == 1 and "python3.11-venv" in done.stderr
    assert not (machine.checkout / ".venv").exists()
