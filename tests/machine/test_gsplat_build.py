"""Compiling gsplat at set-up, with fake compilers."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from helpers import REPOSITORY
from helpers.patience import wait_until

from drivesplat.errors import DeviceError
from drivesplat.machine.compute_capability import covers
from drivesplat.machine.gsplat_build import __main__ as command
from drivesplat.machine.gsplat_build import compile as building
from drivesplat.machine.gsplat_build import diagnose, installed, toolkit
from drivesplat.machine.gsplat_build.toolkit import Toolkit

TOOLKIT = Toolkit(Path("/opt/cuda"), "13.0", "CUDA_HOME")


@pytest.fixture
def package(tmp_path, monkeypatch) -> Path:
    """A gsplat package with only sources, and a separate build folder."""
    folder = tmp_path / "site/gsplat"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    for module in (installed, building):
        monkeypatch.setattr(module, "package_folder", lambda: folder)
    monkeypatch.setattr(building, "build_folder", lambda: tmp_path / "build")
    monkeypatch.setattr(building, "log_file", lambda: tmp_path / "build.log")
    monkeypatch.setattr(building, "POLL_S", 0.02)
    return folder


# Installed kernels.


def test_the_kernels_of_a_prebuilt_wheel_are_found(package):
    (package / f"csrc{installed.EXTENSION_SUFFIXES[0]}").touch()
    assert installed.compiled_extension() == package / f"csrc{installed.EXTENSION_SUFFIXES[0]}"
    assert command.is_compiled(["7.5", "12.0"]), "kernels of a wheel are trusted"


def test_compiled_kernels_are_recorded_with_their_versions(package, tmp_path, monkeypatch):
    (tmp_path / "csrc.so").write_bytes(b"code")
    target = building.install(tmp_path / "csrc.so", package, ["7.5", "8.6"])
    assert target.read_bytes() == b"code" and installed.compiled_extension() == target
    assert installed.build_record()["archs"] == ["7.5", "8.6"]
    assert [file.name for file in package.glob(".*")] == []
    assert command.is_compiled(["8.6"]) and command.is_compiled(["8.9"]) and not command.is_compiled(["9.0"])
    monkeypatch.setattr(installed, "versions", lambda: {"torch": "9.9", "gsplat": "1.5.3"})
    assert installed.compiled_extension() is None and not command.is_compiled(["8.6"])


def test_machine_code_runs_within_a_major_version_and_ptx_later():
    for archs, capability, runs in (
        (["8.6"], (8, 6), True), (["8.6"], (8, 9), True), (["8.9"], (8, 6), False), (["7.5"], (8, 6), False),
        (["8.6+PTX"], (12, 0), True), (["9.0a"], (9, 0), True), (["7.5", "8.0"], (8, 6), True),
        (["12.0"], (8, 6), False), ([], (8, 6), False),
    ):  # fmt: skip
        assert covers(archs, capability) is runs, (archs, capability)


def test_the_platform_of_torch_is_read_without_importing_it():
    module = "drivesplat.machine.gsplat_build.installed"
    code = f"import sys; from {module} import torch_platform as found; print(found(), 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == f"{(torch.version.cuda, torch.version.hip)} False\n"


# Architectures to compile for.


def test_the_variable_takes_precedence_over_the_gpus():
    for variable, gpus, archs in (
        (None, [], []),
        (None, [(8, 6), (7, 5), (6, 1), (8, 6)], ["7.5", "8.6"]),
        ("7.5;8.6;8.9", [(12, 0)], ["7.5", "8.6", "8.9"]),
        ("7.5, 8.6+PTX", [], ["7.5", "8.6+PTX"]),
        ("none", [(8, 6)], []),
    ):
        environment = {} if variable is None else {"GSPLAT_ARCHS": variable}
        assert command.wanted_archs(environment, gpus) == archs, variable


def test_invalid_archs_are_refused_before_compiling():
    assert diagnose.arch_problem(["8.6", "12.0+PTX"], "13.0") is diagnose.arch_problem(["7.0"], "12.6") is None
    for archs, cuda, expected in (
        (["7.0"], "13.0", "TORCH_CUDA=cu126"),
        (["6.1"], "12.6", "7.0 (Volta)"),
        (["sm_86"], "13.0", "7.5;8.6;8.9"),
        (["86"], "13.0", "no compute capability"),
        ([], "13.0", "GSPLAT_ARCHS"),
    ):
        assert expected in diagnose.arch_problem(archs, cuda)


def run_command(monkeypatch, platform, gpus=(), archs=None, done=False, arguments=()):
    monkeypatch.setattr(command, "torch_platform", lambda: platform)
    monkeypatch.setattr(command, "read_gpus", lambda: (list(gpus), None))
    monkeypatch.setattr(command, "is_compiled", lambda _: done)
    monkeypatch.setattr(command, "provide_toolkit", lambda _: TOOLKIT)
    monkeypatch.setattr(diagnose, "missing_prerequisite", lambda: None)
    built = []
    monkeypatch.setattr(building, "compile_and_install", lambda *a: built.append(a) or Path("/gsplat/csrc.so"))
    monkeypatch.delenv("GSPLAT_ARCHS", raising=False)
    if archs:
        monkeypatch.setenv("GSPLAT_ARCHS", archs)
    return command.main(arguments), built


@pytest.mark.parametrize(
    ("platform", "more", "said"),
    [
        (("13.0", None), {}, "no NVIDIA GPU here"),
        (("13.0", None), {"arguments": ["--if-needed"]}, ""),
        (("13.0", None), {"archs": "7.5", "done": True}, ""),
        ((None, None), {"archs": "8.6"}, "CPU alone"),
        ((None, "6.4"), {"archs": "8.6"}, "docs/amd.md"),
    ],
)
def test_nothing_is_compiled_where_nothing_is_needed(monkeypatch, capsys, platform, more, said):
    """Not without a GPU, for other platforms, or a second time; a line says why, unless asked only where needed."""
    assert run_command(monkeypatch, platform, **more) == (0, [])
    printed = capsys.readouterr().err
    assert said in printed if said else printed == ""


def test_named_archs_are_compiled_without_a_gpu_with_an_estimate(monkeypatch, capsys):
    monkeypatch.setenv("MAX_JOBS", "2")
    status, built = run_command(monkeypatch, ("13.0", None), archs="7.5;8.9")
    printed = capsys.readouterr().err
    assert status == 0 and built[0][:3] == (TOOLKIT, ["7.5", "8.9"], 2)
    assert f"about {building.expected_minutes(2, 2)} min" in printed and "build.log" in printed


def test_a_missing_compiler_is_an_error_with_what_to_install(monkeypatch, capsys):
    assert run_command(monkeypatch, ("13.0", None), archs="7.5")[0] == 0
    monkeypatch.setattr(command, "provide_toolkit", lambda _: pytest.fail("installed in vain"))
    monkeypatch.setattr(diagnose, "missing_prerequisite", lambda: "no C++ compiler: `sudo apt-get install g++`")
    assert command.main([]) == 1 and "apt-get install g++" in capsys.readouterr().err


def test_a_cpp_compiler_and_python_headers_are_looked_for(monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "apt-get install g++" in diagnose.missing_prerequisite()
    (tmp_path / "c++").touch(mode=0o755)
    monkeypatch.setattr(diagnose.sysconfig, "get_paths", lambda: {"include": str(tmp_path)})
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert f"apt-get install python{version}-dev" in diagnose.missing_prerequisite()
    (tmp_path / "Python.h").touch()
    assert diagnose.missing_prerequisite() is None


# The toolkit.


def make_toolkit(home: Path, release: str) -> Path:
    (home / "bin").mkdir(parents=True)
    (home / "include").mkdir()
    (home / "include/cuda_runtime.h").touch()
    (home / "bin/nvcc").write_text(f"#!/bin/sh\necho 'Cuda compilation tools, release {release}, V{release}.1'\n")
    (home / "bin/nvcc").chmod(0o755)
    return home


@pytest.fixture
def no_toolkit(monkeypatch, tmp_path):
    for variable in ("CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(toolkit, "system_homes", lambda: iter(()))


def test_cuda_home_is_used_if_it_has_torchs_major_version(no_toolkit, monkeypatch, tmp_path):
    monkeypatch.setenv("CUDA_HOME", str(make_toolkit(tmp_path / "cuda", "13.2")))
    assert toolkit.provide_toolkit("13.0") == Toolkit(tmp_path / "cuda", "13.2", "CUDA_HOME")
    with pytest.raises(DeviceError, match=r"nvcc 13\.2, but torch is built for CUDA 12\.6"):
        toolkit.provide_toolkit("12.6")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "none"))
    with pytest.raises(DeviceError, match="no bin/nvcc"):
        toolkit.provide_toolkit("13.0")


def test_cuda_13_comes_from_pypi(no_toolkit, monkeypatch):
    monkeypatch.setattr(toolkit, "_from_pypi", lambda: TOOLKIT)
    assert toolkit.provide_toolkit("13.0") is TOOLKIT
    with pytest.raises(DeviceError, match=r"PyPI has no nvcc for CUDA 12\.6.*CUDA_HOME="):
        toolkit.provide_toolkit("12.6")


def test_without_pypi_an_installed_toolkit_is_used(no_toolkit, monkeypatch, tmp_path):
    def unreachable():
        raise DeviceError("`pip install` failed (no route)")

    monkeypatch.setattr(toolkit, "_from_pypi", unreachable)
    with pytest.raises(DeviceError, match=r"no route.*CUDA_HOME="):
        toolkit.provide_toolkit("13.0")
    homes = [make_toolkit(tmp_path / "a", "12.4"), make_toolkit(tmp_path / "b", "13.1")]
    monkeypatch.setattr(toolkit, "system_homes", lambda: iter(homes))
    assert toolkit.provide_toolkit("13.0").home == tmp_path / "b"
    assert toolkit.provide_toolkit("12.6").home == tmp_path / "a"


def test_packages_from_pypi_are_arranged_for_linkers(tmp_path):
    packages = make_toolkit(tmp_path / "nvidia/cu13", "13.0")
    for name in ("lib/libcudart.so.13", "lib/libcublas.so.13", "nvvm/bin/cicc"):
        (packages / name).parent.mkdir(parents=True, exist_ok=True)
        (packages / name).touch()
    for _ in range(2):  # a second time over the first
        home = toolkit.arrange(packages, tmp_path / "venv/cuda-toolkit")
    assert toolkit.nvcc_release(home) == "13.0"
    assert (home / "lib64/libcudart.so").resolve() == packages / "lib/libcudart.so.13"
    assert (home / "lib64/libcublas.so.13").exists() and (home / "nvvm/bin/cicc").exists()


# Compiling.


def test_the_compiler_uses_the_given_toolkit(monkeypatch):
    monkeypatch.setenv("CUDA_HOME", "/usr/local/cuda")
    monkeypatch.setenv("PATH", "/usr/bin")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "5.0")
    env = building.compile_environment(TOOLKIT, ["7.5", "8.6"], 3)
    assert env["CUDA_HOME"] == "/opt/cuda" and env["TORCH_CUDA_ARCH_LIST"] == "7.5;8.6" and env["MAX_JOBS"] == "3"
    assert env["PATH"].split(":") == [str(Path(sys.executable).parent), "/opt/cuda/bin", "/usr/bin"]
    assert str(REPOSITORY) in env["PYTHONPATH"].split(":")


def shell(script: str) -> list[str]:
    return ["bash", "-c", textwrap.dedent(script)]


def test_progress_is_reported_with_the_remaining_time(package, tmp_path):
    printed = []
    steps = shell("echo '[1/2] nvcc one'; sleep 0.1; echo '[2/2] nvcc two'; sleep 0.1")
    building.run_with_progress(steps, os.environ, tmp_path / "log", printed.append)
    assert [line.split()[0] for line in printed] == ["1/2", "2/2"] and "min to go" in printed[0]


def test_an_interruption_ends_the_compilers(package, tmp_path, monkeypatch):
    log = tmp_path / "log"

    def interrupt(_):
        if log.stat().st_size:
            raise KeyboardInterrupt

    monkeypatch.setattr(building.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        building.run_with_progress(shell("sleep 60 & echo $!; wait"), os.environ, log, print)
    compiler = Path("/proc", log.read_text().strip(), "stat")
    monkeypatch.undo()
    wait_until(lambda: not compiler.exists() or compiler.read_text().split()[2] == "Z")


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        ("c++: fatal error: Killed signal terminated program cc1plus", "MAX_JOBS=1"),
        ("nvcc error : 'cicc' died due to signal 9 (Kill signal)", "MAX_JOBS=1"),
        ("error: #error -- unsupported GNU version! gcc versions later than 15 are not supported!", "CXX=g++-13"),
        ("nvcc fatal   : Unsupported gpu architecture 'compute_70'", "GSPLAT_ARCHS"),
        ("fatal error: Python.h: No such file or directory", "python3-dev"),
        ("fatal error: cusparse.h: No such file or directory", "CUDA_HOME"),
        ("/usr/bin/ld: cannot find -lcudart: No such file or directory", "libcudart"),
        ('error: namespace "cooperative_groups" has no member "labeled_partition"', "7.0"),
        ("fatal error: error writing to /tmp/x.s: No space left on device", "disk is full"),
        ("/bin/sh: 1: c++: not found", "apt-get install g++"),
        ("something nobody has seen", "docs/installation.md"),
    ],
)
def test_a_failed_build_names_its_cause_and_the_log(package, tmp_path, log, expected):
    lines = []
    with pytest.raises(DeviceError) as error:
        building.run_with_progress(
            ["bash", "-c", f'echo {"x" * 5000}; echo "$0"; exit 1', log], os.environ, tmp_path / "log", lines.append
        )
    assert expected in str(error.value) and str(tmp_path / "log") in str(error.value)
    assert log in "\n".join(lines) and max(map(len, "\n".join(lines).splitlines())) < 400


def fake_job(monkeypatch, body: str) -> None:
    monkeypatch.setattr(building.sys, "executable", "/bin/true")
    real = building.run_with_progress
    monkeypatch.setattr(
        building, "run_with_progress", lambda command, *rest: real([*shell(body), "job", command[-1]], *rest)
    )
    monkeypatch.setattr(building, "check_loads", lambda env: None)


def test_a_build_is_installed_in_the_package_and_leaves_nothing_else(package, monkeypatch, tmp_path):
    """Not even a lock that a killed one has left."""
    fake_job(monkeypatch, 'echo "[1/1] nvcc"; test ! -e "$1/lock" && echo code > "$1/csrc.so"')
    (tmp_path / "build").mkdir()
    (tmp_path / "build/lock").touch()
    target = building.compile_and_install(TOOLKIT, ["8.6"], 1, print)
    assert target == package / "csrc.so" and target.read_text() == "code\n"
    assert not (tmp_path / "build").exists()


def test_a_second_concurrent_build_is_refused(package, tmp_path):
    with building._exclusive(tmp_path / "build"), pytest.raises(DeviceError, match="another process"):
        building.compile_and_install(TOOLKIT, ["8.6"], 1, print)


def test_the_result_is_imported_as_in_a_run(tmp_path):
    backend = tmp_path / "gsplat/cuda/_backend.py"
    backend.parent.mkdir(parents=True)
    for folder in (backend.parent, backend.parent.parent):
        (folder / "__init__.py").touch()
    kernels = tmp_path / "gsplat/csrc.py"
    kernels.write_text("import os; assert 'CUDA_HOME' not in os.environ")
    backend.write_text("from gsplat import csrc as _C")
    env = {"PYTHONPATH": str(tmp_path), "CUDA_HOME": "/opt/cuda"}
    building.check_loads(env)
    backend.write_text("_C = None")
    with pytest.raises(DeviceError, match="cannot be loaded"):
        building.check_loads(env)
    kernels.write_text("raise ImportError('undefined symbol: _ZN3c10')")
    backend.write_text("import sys; sys.exit('compiles for minutes')")
    with pytest.raises(DeviceError, match="undefined symbol"):
        building.check_loads(env)
