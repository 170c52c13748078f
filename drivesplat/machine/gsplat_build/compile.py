"""Compiling gsplat's kernels with progress, and putting them where gsplat's loader looks first."""

import fcntl
import json
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
from drivesplat.machine.gsplat_build import diagnose
from drivesplat.machine.gsplat_build.installed import RECORD, package_folder, versions
from drivesplat.machine.gsplat_build.toolkit import Toolkit

JOB_MEMORY_GB = 2.5
"""What one nvcc takes at its peak, with room."""
FIXED_CORE_SECONDS = 150
CORE_SECONDS_PER_ARCH = 400
"""Measured with CUDA 13.0 on shared server cores: 560 s for one compute capability, 1,380 s for three."""
STEP = re.compile(r"^\[(\d+)/(\d+)\] ", re.MULTILINE)
POLL_S = 1.0
Say = Callable[[str], None]


def build_folder() -> Path:
    """Where objects are kept until all are compiled, so that an interrupted build goes on where it stopped."""
    return Path(sys.prefix) / "gsplat-build"


def log_file() -> Path:
    """The log of the last build."""
    return Path(sys.prefix) / "gsplat-build.log"


def free_memory_gb(meminfo: Path = Path("/proc/meminfo")) -> float:
    """Main memory that programs may still take, in GB; a cautious 4 where the system does not tell."""
    try:
        match = re.search(r"MemAvailable:\s+(\d+) kB", meminfo.read_text())
    except OSError:
        match = None
    return int(match[1]) * 1024 / 1e9 if match else 4.0


def parallel_jobs(cores: int, memory_gb: float) -> int:
    """How many compilers may run at once without exhausting memory."""
    return max(1, min(cores, int(memory_gb / JOB_MEMORY_GB)))


def expected_minutes(archs: int, jobs: int) -> int:
    """A guess at how long compiling for so many compute capabilities takes, in whole minutes."""
    return max(1, round((FIXED_CORE_SECONDS + CORE_SECONDS_PER_ARCH * archs) / jobs / 60))


def compile_environment(toolkit: Toolkit, archs: Sequence[str], jobs: int) -> dict[str, str]:
    """The variables under which torch compiles; nothing of them is needed afterwards."""
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


def compile_and_install(toolkit: Toolkit, archs: Sequence[str], jobs: int, say: Say) -> Path:
    """Compiles for `archs`, installs the result into the gsplat package and tries it in a fresh process.

    Returns the installed file. Raises DeviceError with the end of the log, its place and the cause where it is known.
    """
    package = package_folder()
    if package is None:
        raise DeviceError("gsplat is not installed in this Python; run `make setup`")
    folder = build_folder()
    with _alone(folder):
        (folder / "lock").unlink(missing_ok=True)  # torch waits for ever on one that an interrupted build left
        command = [sys.executable, "-m", "drivesplat.machine.gsplat_build.compile_job", str(folder)]
        run_with_progress(command, compile_environment(toolkit, archs, jobs), log_file(), say)
        installed = install(folder / "csrc.so", package, archs)
    check_loads(os.environ)
    shutil.rmtree(folder, ignore_errors=True)
    return installed


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder.with_suffix(".lock"), "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise DeviceError(
                f"gsplat is being compiled by another process already (in {folder}); wait for it"
            ) from None
        os.set_inheritable(lock.fileno(), True)  # compilers that outlive this process keep it
        yield


def run_with_progress(command: Sequence[str], env: Mapping[str, str], log: Path, say: Say) -> None:
    """Runs a build that ninja reports on, saying how far it is. Raises DeviceError where it fails."""
    start, reported = time.monotonic(), 0
    with open(log, "wb") as output:
        process = subprocess.Popen(
            command, env=dict(env), stdout=output, stderr=subprocess.STDOUT, start_new_session=True, close_fds=False
        )
        try:
            while process.poll() is None:
                time.sleep(POLL_S)
                reported = _report(log, start, reported, say)
        finally:
            if process.poll() is None:  # interrupted: ninja and its compilers go, too
                os.killpg(process.pid, signal.SIGTERM)
                process.wait()
    if process.returncode:
        text = log.read_text(errors="replace")
        say(diagnose.last_lines(text))
        why = diagnose.cause(text) or "see the lines above; docs/installation.md lists known causes"
        raise DeviceError(f"compiling gsplat failed: {why} (whole log: {log})")


def _report(log: Path, start: float, reported: int, say: Say) -> int:
    steps = STEP.findall(log.read_text(errors="replace"))
    if not steps or int(steps[-1][0]) <= reported:
        return reported
    done, total = int(steps[-1][0]), int(steps[-1][1])
    elapsed = time.monotonic() - start
    left = elapsed / done * (total - done)
    say(f"{done}/{total} files compiled, {elapsed / 60:.0f} min so far, about {max(1, round(left / 60))} min to go")
    return done


def install(built: Path, package: Path, archs: Iterable[str]) -> Path:
    """Puts compiled kernels into the gsplat package, whole or not at all, with a note of what they are for."""
    if not built.is_file():
        raise DeviceError(f"compiling gsplat left no {built}; the log is {log_file()}")
    target = package / "csrc.so"
    (package / RECORD).unlink(missing_ok=True)
    aside = package / ".csrc.so.partial"
    shutil.copyfile(built, aside)
    aside.replace(target)
    note = {"archs": list(archs), "versions": versions()}
    (package / RECORD).write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
    return target


def check_loads(env: Mapping[str, str]) -> None:
    """Imports gsplat's kernels as a run will: a fresh process, no nvcc in PATH. Raises DeviceError where that fails."""
    script = "import gsplat.csrc; from gsplat.cuda._backend import _C; assert _C is gsplat.csrc, _C"
    plain = {name: value for name, value in env.items() if name not in ("CUDA_HOME", "CUDA_PATH")}
    plain["PATH"] = "/usr/bin:/bin"
    done = subprocess.run([sys.executable, "-c", script], env=plain, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise DeviceError(f"gsplat was compiled but cannot be loaded ({last}); remove .venv and run `make setup` again")
