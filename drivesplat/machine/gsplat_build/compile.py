"""Compiling gsplat's kernels with progress reports, and installing them where gsplat's loader looks first."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from drivesplat.errors import DeviceError
from drivesplat.io.file_lock import LockHeldError, locked_file
from drivesplat.io.storage import atomic_path, write_json
from drivesplat.machine.gsplat_build import diagnose
from drivesplat.machine.gsplat_build.installed import RECORD, package_folder, versions
from drivesplat.machine.gsplat_build.toolkit import Toolkit

JOB_MEMORY_GB = 2.5
"""Peak memory of one nvcc process, with a margin."""
FIXED_CORE_SECONDS = 150
CORE_SECONDS_PER_ARCH = 400
"""Measured with CUDA 13.0 on shared server cores: 560 s for one compute capability, 1,380 s for three."""
STEP = re.compile(r"^\[(\d+)/(\d+)\] ", re.MULTILINE)
POLL_S = 1.0
Report = Callable[[str], None]


def build_folder() -> Path:
    """The folder of object files until all are compiled, so that an interrupted build can continue."""
    return Path(sys.prefix) / "gsplat-build"


def log_file() -> Path:
    """The log of the last build."""
    return Path(sys.prefix) / "gsplat-build.log"


def free_memory_gb(meminfo: Path = Path("/proc/meminfo")) -> float:
    """Available main memory in GB; 4 if the system does not report it."""
    try:
        match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo.read_text())
    except OSError:
        match = None
    return int(match[1]) * 1024 / 1e9 if match else 4.0


def parallel_jobs(cores: int, memory_gb: float) -> int:
    """How many compilers can run at once without exhausting memory."""
    return max(1, min(cores, int(memory_gb / JOB_MEMORY_GB)))


def expected_minutes(archs: int, jobs: int) -> int:
    """The estimated duration of compiling for this number of compute capabilities."""
    return max(1, round((FIXED_CORE_SECONDS + CORE_SECONDS_PER_ARCH * archs) / jobs / 60))


def compile_environment(toolkit: Toolkit, archs: Sequence[str], jobs: int) -> dict[str, str]:
    """The environment in which torch compiles; not needed afterwards."""
    repository = str(Path(__file__).parents[3])
    tools = [str(Path(sys.executable).parent), str(toolkit.home / "bin"), os.environ.get("PATH", os.defpath)]
    return {
        **os.environ,
        "CUDA_HOME": str(toolkit.home),
        "TORCH_CUDA_ARCH_LIST": ";".join(archs),
        "MAX_JOBS": str(jobs),
        "PATH": os.pathsep.join(tools),
        "PYTHONPATH": os.pathsep.join(filter(None, [repository, os.environ.get("PYTHONPATH")])),
    }


def compile_and_install(toolkit: Toolkit, archs: Sequence[str], jobs: int, report: Report) -> Path:
    """Compiles for `archs`, installs the result into the gsplat package and imports it in a new process.

    Returns the installed file. Raises DeviceError with the path of the log and the cause, if it is known.
    """
    package = package_folder()
    if package is None:
        raise DeviceError("gsplat is not installed in this Python; run `make setup`")
    folder = build_folder()
    with _exclusive(folder):
        (folder / "lock").unlink(missing_ok=True)  # torch would wait forever for the lock of an interrupted build
        script = f"import sys; from {__name__} import compile_in; compile_in(sys.argv[1])"
        command = [sys.executable, "-c", script, str(folder)]
        run_with_progress(command, compile_environment(toolkit, archs, jobs), log_file(), report)
        installed = install(folder / "csrc.so", package, archs)
    check_loads(os.environ)
    shutil.rmtree(folder, ignore_errors=True)
    return installed


@contextmanager
def _exclusive(folder: Path) -> Iterator[None]:
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = locked_file(folder.with_suffix(".lock"))
    except LockHeldError:
        raise DeviceError(f"another process is compiling gsplat (in {folder}); wait for it") from None
    with lock:
        os.set_inheritable(lock.fileno(), True)  # compilers that outlive this process keep the lock
        yield


def run_with_progress(command: Sequence[str], env: Mapping[str, str], log: Path, report: Report) -> None:
    """Runs a build with ninja and reports its progress. Raises DeviceError if it fails."""
    start, reported = time.monotonic(), 0
    with open(log, "wb") as output:
        process = subprocess.Popen(
            command, env=dict(env), stdout=output, stderr=subprocess.STDOUT, start_new_session=True, close_fds=False
        )
        try:
            while process.poll() is None:
                time.sleep(POLL_S)
                steps = STEP.findall(log.read_text(errors="replace"))
                done, total = map(int, steps[-1]) if steps else (0, 0)
                if done > reported:
                    reported, elapsed = done, (time.monotonic() - start) / 60
                    remaining = max(1, round(elapsed / done * (total - done)))
                    report(f"{done}/{total} files compiled, {elapsed:.0f} min so far, about {remaining} min to go")
        finally:
            if process.poll() is None:  # interrupted: end ninja and its compilers, too
                os.killpg(process.pid, signal.SIGTERM)
                process.wait()
    if process.returncode:
        text = log.read_text(errors="replace")
        report(diagnose.last_lines(text))
        why = diagnose.cause(text) or "see the lines above; docs/installation.md lists known causes"
        raise DeviceError(f"compiling gsplat failed: {why} (whole log: {log})")


def install(built: Path, package: Path, archs: Iterable[str]) -> Path:
    """Copies compiled kernels into the gsplat package atomically, with a record of what they were compiled for."""
    if not built.is_file():
        raise DeviceError(f"compiling gsplat did not create {built}; the log is {log_file()}")
    target = package / "csrc.so"
    (package / RECORD).unlink(missing_ok=True)
    with atomic_path(target) as temporary:
        shutil.copyfile(built, temporary)
    write_json(package / RECORD, {"archs": list(archs), "versions": versions()})
    return target


def check_loads(env: Mapping[str, str]) -> None:
    """Imports gsplat's kernels as a run does: in a new process without nvcc in PATH. Raises DeviceError on failure."""
    script = "import gsplat.csrc; from gsplat.cuda._backend import _C; assert _C is gsplat.csrc, _C"
    plain = {name: value for name, value in env.items() if name not in ("CUDA_HOME", "CUDA_PATH")}
    plain["PATH"] = "/usr/bin:/bin"
    done = subprocess.run([sys.executable, "-c", script], env=plain, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise DeviceError(f"gsplat was compiled but cannot be loaded ({last}); remove .venv and run `make setup` again")


def sources(package: Path) -> list[str]:
    """gsplat's kernels and their Python bindings."""
    cuda = package / "cuda"
    return [str(path) for path in (*sorted(cuda.glob("csrc/*.cu")), *sorted(cuda.glob("csrc/*.cpp")), cuda / "ext.cpp")]


def compile_in(folder: str) -> None:
    """Compiles gsplat's kernels as the module `csrc` into a folder and imports it, with the flags of gsplat's build.

    Runs in a process of its own: torch reads CUDA_HOME, TORCH_CUDA_ARCH_LIST and MAX_JOBS once, and ninja writes to its
    output.
    """
    from torch.utils.cpp_extension import load

    package = package_folder()
    load(
        name="csrc",
        sources=sources(package),
        extra_cflags=["-O3", "-Wno-attributes"],
        extra_cuda_cflags=["-O3", "-use_fast_math"],
        extra_include_paths=[str(package / "cuda/include"), str(package / "cuda/csrc/third_party/glm")],
        build_directory=folder,
        verbose=True,
    )
