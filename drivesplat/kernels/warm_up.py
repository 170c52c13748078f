"""What compiles and caches kernels beforehand, and what is known to be compiled."""

import argparse
import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.provenance.code.code_digest import code_digest


def run_warm_up(module: str, warm_up: Callable[[Path], None], arguments: Sequence[str]) -> int:
    """Runs `warm_up` in an empty folder, without messages of its own, as the command `python -m module`. Returns the
    exit status."""
    argparse.ArgumentParser(f"python -m {module}", description=warm_up.__doc__).parse_args(arguments)
    logging.disable(logging.INFO)
    try:
        with tempfile.TemporaryDirectory() as folder:
            warm_up(Path(folder))
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1
    return 0


def compile_cuda(capability: str) -> int:
    """Compiles the CUDA C++ programs that jobs use into the cache, for GPUs of a compute capability such as "90", where
    they are missing. Needs no GPU. Returns their number. Raises DeviceError where they cannot be compiled."""
    from drivesplat.kernels.cuda.compiled import compile_ahead

    return compile_ahead(capability)


def triton_mark(capabilities: Collection[tuple[int, int]]) -> Path:
    """The path of a file beside Triton's compiled kernels. It exists where those of this code are compiled for GPUs of
    these compute capabilities."""
    import triton

    files = sorted((Path(__file__).parent / "triton").glob("*.py"))
    digest = hashlib.sha256("".join(map(code_digest, files)).encode()).hexdigest()
    kinds = "-".join(f"sm{major}{minor}" for major, minor in sorted(capabilities))
    folder = os.environ.get("TRITON_CACHE_DIR") or Path.home() / ".triton" / "cache"
    return Path(folder) / f"drivesplat-{digest[:16]}-{triton.__version__}-{kinds}"
