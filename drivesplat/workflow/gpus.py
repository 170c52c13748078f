"""Visible GPUs, counted without importing torch, and locks that give each job a GPU of its own."""

import logging
import os
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from drivesplat.errors import DeviceError
from drivesplat.io.file_lock import LockHeldError, locked_file

log = logging.getLogger(__name__)

VARIABLES = ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES")
"""Environment variables with which a user or scheduler selects GPUs; the first one that is set counts."""
PATIENCE_S = 1.0
"""Seconds between two attempts to lock a GPU."""


def visible_gpus() -> int:
    """The number of GPUs of any vendor that this process may use; at least 1, so that GPU rules can run on a CPU."""
    return max(1, len(_visible()[1]))


def any_gpu() -> bool:
    """Whether this process may use a GPU of any vendor."""
    return bool(_visible()[1])


def hold_gpu(jobs_per_card: int) -> BinaryIO | None:
    """Locks a GPU that fewer than `jobs_per_card` jobs of this user hold on this machine, and hides all others from
    this process. Must be called before any library looks for a GPU.

    Returns the locked file: the lock lasts until the file is closed or the process ends. Returns None without a GPU,
    and for a single GPU assigned by a scheduler, whose identity is unknown. Waits, with a warning, while all GPUs are
    taken. Raises DeviceError where no lock file can be written.
    """
    variable, names = _visible()
    # Names that do not depend on which are visible (a scheduler may show every job its GPU as number 0): UUIDs, or
    # numbers if nvidia-smi is not available.
    known: dict[str, str] = {}
    if any(name.isdigit() for name in names):
        command = ("nvidia-smi", "--query-gpu=index,uuid", "--format=csv,noheader")
        with suppress(OSError, subprocess.SubprocessError):
            lines = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout.splitlines()
            known = dict(line.replace(" ", "").split(",", 1) for line in lines if "," in line)
    gpus = {name: known.get(name, name) for name in names}
    if not gpus or (len(gpus) == 1 and variable in os.environ and next(iter(gpus.values())).isdigit()):
        return None
    warned = False
    while True:
        gpu, lock, holders = _free_gpu(gpus, jobs_per_card)
        if lock is not None:
            os.environ[variable] = gpu
            log.info("runs on the GPU %s (%s)", gpu, gpus[gpu])
            return lock
        if not warned:
            log.warning(
                "waits for a GPU: jobs hold all there are (%d; processes %s); device.jobs_per_card lets more share one",
                len(gpus),
                ", ".join(holders),
            )
            warned = True
        time.sleep(PATIENCE_S)


def _free_gpu(gpus: dict[str, str], jobs_per_card: int) -> tuple[str, BinaryIO | None, list[str]]:
    """The GPU with the fewest jobs and a lock on it; or no lock, and the processes that hold all locks. `cards` are
    identities by name."""
    holders = []
    for place in range(jobs_per_card):
        for gpu, identity in gpus.items():
            path = Path(tempfile.gettempdir(), f"drivesplat-cards-{os.getuid()}", f"{identity}.{place}")
            try:
                path.parent.mkdir(mode=0o700, exist_ok=True)
                return gpu, locked_file(path), []
            except LockHeldError as error:
                holders.append(error.holder)
            except OSError as error:
                raise DeviceError(
                    f"{path}: cannot be written ({error.strerror or error}), and says which job has which GPU; "
                    "fix its permissions, or set TMPDIR to a folder of this machine"
                ) from error
    return "", None, holders


def _visible() -> tuple[str, list[str]]:
    """The environment variable that selects GPUs, and the names in it."""
    for variable in VARIABLES:
        if variable in os.environ:
            names = (name.strip() for name in os.environ[variable].split(","))
            return variable, [name for name in names if name not in ("", "-1")]
    nvidia = [p for p in Path("/dev").glob("nvidia[0-9]*") if p.name[6:].isdigit()]
    amd = [p for p in Path("/sys/class/kfd/kfd/topology/nodes").glob("*/gpu_id") if p.read_text().strip() != "0"]
    variable = "HIP_VISIBLE_DEVICES" if amd and not nvidia else "CUDA_VISIBLE_DEVICES"
    return variable, [str(number) for number in range(len(nvidia) or len(amd))]
