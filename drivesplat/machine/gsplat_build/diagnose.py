"""Why compiling gsplat failed or cannot start, as a sentence with what to do."""

import os
import re
import shutil
import sysconfig
from collections.abc import Iterable
from pathlib import Path

from drivesplat.machine.compute_capability import MIN_CAPABILITY, parse_arch

MIN_CAPABILITY_BY_CUDA = {13: (7, 5)}
"""nvcc of CUDA 13 no longer supports Volta and older GPUs."""
CAUSES = (
    (
        r"Killed|Kill signal|[Cc]annot allocate memory|std::bad_alloc|virtual memory exhausted",
        "the machine ran out of memory while compiling: continue it with `MAX_JOBS=1 make setup`",
    ),
    (r"No space left on device", "the disk is full: free about 2 GB, then run `make setup` again"),
    (
        r"unsupported GNU version|unsupported clang version|host compiler is not supported",
        "the C++ compiler is too new for nvcc: install an older one (e.g. `sudo apt-get install g++-13`), then "
        "`CC=gcc-13 CXX=g++-13 make setup`",
    ),
    (
        r"Unsupported gpu architecture|Unknown CUDA arch",
        "nvcc does not support a compute capability: name only those of your GPUs, `GSPLAT_ARCHS=8.6 make setup`",
    ),
    (
        r"fatal error: Python\.h",
        "Python's headers are missing: `sudo apt-get install python3-dev`, then run `make setup` again",
    ),
    (
        r"has no member .?labeled_partition",
        "gsplat needs compute capability 7.0 (Volta) or newer: remove older ones from GSPLAT_ARCHS",
    ),
    (
        r"fatal error: (cusparse|cublas|cusolver|cuda_runtime|thrust|cub)\S*: No such file",
        "the CUDA toolkit is incomplete: unset CUDA_HOME to use the one from PyPI, or install the whole toolkit",
    ),
    (r"cannot find -lcudart", "the CUDA toolkit has no libcudart.so to link with: install its development libraries"),
    (r"(gcc|g\+\+|c\+\+|cc1plus)\S*: (not found|No such file)", "no C++ compiler: `sudo apt-get install g++`"),
)
TAIL_LINES = 12
TAIL_WIDTH = 300


def cause(log: str) -> str | None:
    """The known cause that a build's log names, with what to do; None if there is none."""
    return next((what for pattern, what in CAUSES if re.search(pattern, log)), None)


def last_lines(log: str) -> str:
    """The first errors and the end of a build's log, long lines shortened."""
    lines = [line for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"\b(fatal|error|FAILED)\b|Killed", line)]
    shown = lines[-TAIL_LINES:]
    shown = [line for line in errors[:4] if line not in shown] + shown
    return "\n".join(line if len(line) <= TAIL_WIDTH else line[:TAIL_WIDTH] + " …" for line in shown)


def missing_prerequisite() -> str | None:
    """What compiling needs and this machine lacks, with what to install; None if nothing is missing."""
    compiler = os.environ.get("CXX", "c++").split()[0]
    if shutil.which(compiler) is None:
        return f"no C++ compiler ({compiler}): `sudo apt-get install g++`, then run `make setup` again"
    include = sysconfig.get_paths()["include"]
    if not Path(include, "Python.h").is_file():
        name = f"python{sysconfig.get_python_version()}-dev"
        return f"Python's headers are missing ({include}/Python.h): `sudo apt-get install {name}`, then `make setup`"
    return None


def arch_problem(archs: Iterable[str], torch_cuda: str) -> str | None:
    """The problem with the architectures to compile for, such as "8.6"; None if there is none."""
    archs = list(archs)
    if not archs:
        return 'no compute capability to compile for: name those of your GPUs, as GSPLAT_ARCHS="7.5;8.6"'
    for arch in archs:
        parsed = parse_arch(arch)
        if parsed is None:
            return f'GSPLAT_ARCHS: {arch!r} is no compute capability; write them as "7.5;8.6;8.9" (no GPU needed)'
        capability, _ = parsed
        if capability < MIN_CAPABILITY:
            return (
                f"gsplat cannot be compiled for compute capability {arch}: it needs 7.0 (Volta) or newer; "
                "with such a GPU only the CPU demo runs"
            )
        if capability < MIN_CAPABILITY_BY_CUDA.get(int(torch_cuda.split(".")[0]), MIN_CAPABILITY):
            return (
                f"CUDA {torch_cuda} cannot compile for compute capability {arch}; install torch's CUDA 12.6 build: "
                "TORCH_CUDA=cu126 make setup"
            )
    return None
