"""Why compiling gsplat failed or cannot begin, as a sentence with what to do."""

import os
import re
import shutil
import sysconfig
from collections.abc import Iterable
from pathlib import Path

OLDEST_CARD = (7, 0)
"""gsplat's kernels need cooperative groups' labeled_partition, which cards before Volta lack."""
OLDEST_BY_CUDA = {13: (7, 5)}
"""nvcc of CUDA 13 has dropped Volta and older cards."""
ARCH = re.compile(r"(\d+)\.(\d)a?(\+PTX)?")
CAUSES = (
    (
        r"Killed|Kill signal|[Cc]annot allocate memory|std::bad_alloc|virtual memory exhausted",
        "the machine ran out of memory while compiling: run `MAX_JOBS=1 make setup`, which goes on where it stopped",
    ),
    (r"No space left on device", "the disk is full: free about 2 GB, then run `make setup` again"),
    (
        r"unsupported GNU version|unsupported clang version|host compiler is not supported",
        "the C++ compiler is newer than nvcc knows: install an older one (e.g. `sudo apt-get install g++-13`), then "
        "`CC=gcc-13 CXX=g++-13 make setup`",
    ),
    (
        r"Unsupported gpu architecture|Unknown CUDA arch",
        "nvcc does not know one of the compute capabilities: name those of your cards, `GSPLAT_ARCHS=8.6 make setup`",
    ),
    (
        r"fatal error: Python\.h",
        "Python's headers are missing: `sudo apt-get install python3-dev`, then run `make setup` again",
    ),
    (
        r"has no member .?labeled_partition",
        "gsplat needs a card of compute capability 7.0 (Volta) or newer: leave older ones out of GSPLAT_ARCHS",
    ),
    (
        r"fatal error: (cusparse|cublas|cusolver|cuda_runtime|thrust|cub)\S*: No such file",
        "the CUDA toolkit is incomplete: unset CUDA_HOME to take the one from PyPI, or install the whole toolkit",
    ),
    (r"cannot find -lcudart", "the CUDA toolkit has no libcudart.so to link with: install its development libraries"),
    (r"(gcc|g\+\+|c\+\+|cc1plus)\S*: (not found|No such file)", "there is no C++ compiler: `sudo apt-get install g++`"),
)
TAIL_LINES = 12
TAIL_WIDTH = 300


def cause(log: str) -> str | None:
    """The known cause that a build's log speaks of, with what to do; None where it is none of them."""
    return next((what for pattern, what in CAUSES if re.search(pattern, log)), None)


def last_lines(log: str) -> str:
    """The end of a build's log as a user can read it: nvcc's command lines, thousands of characters long, cut."""
    lines = [line for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"\b(fatal|error|FAILED)\b|Killed", line)]
    shown = lines[-TAIL_LINES:]
    shown = [line for line in errors[:4] if line not in shown] + shown
    return "\n".join(line if len(line) <= TAIL_WIDTH else line[:TAIL_WIDTH] + " …" for line in shown)


def what_is_missing() -> str | None:
    """What compiling needs and this machine lacks, with what to install; None where all is there."""
    compiler = os.environ.get("CXX", "c++").split()[0]
    if shutil.which(compiler) is None:
        return f"there is no C++ compiler ({compiler}): `sudo apt-get install g++`, then run `make setup` again"
    include = sysconfig.get_paths()["include"]
    if not Path(include, "Python.h").is_file():
        name = f"python{sysconfig.get_python_version()}-dev"
        return f"Python's headers are missing ({include}/Python.h): `sudo apt-get install {name}`, then `make setup`"
    return None


def arch_problem(archs: Iterable[str], torch_cuda: str) -> str | None:
    """What is wrong with the compute capabilities to compile for; None where they can be."""
    archs = list(archs)
    if not archs:
        return 'no compute capability to compile for: give those of your cards, as GSPLAT_ARCHS="7.5;8.6"'
    for arch in archs:
        match = ARCH.fullmatch(arch)
        if match is None:
            return f'GSPLAT_ARCHS: {arch!r} is no compute capability; write them as "7.5;8.6;8.9" (no GPU needed)'
        capability = (int(match[1]), int(match[2]))
        if capability < OLDEST_CARD:
            return (
                f"gsplat cannot be compiled for compute capability {arch}: it needs 7.0 (Volta) or newer; "
                "such a card can only run the CPU demo"
            )
        if capability < OLDEST_BY_CUDA.get(int(torch_cuda.split(".")[0]), OLDEST_CARD):
            return (
                f"CUDA {torch_cuda} cannot compile for compute capability {arch}; take torch's CUDA 12.6 build: "
                "TORCH_CUDA=cu126 make setup"
            )
    return None
