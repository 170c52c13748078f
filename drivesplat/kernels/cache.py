"""Functions compiled by numba and cached on disk. A change of any code that they may contain invalidates the cache.

numba's own cache checks only the modification time of a function's file: it misses changes of imported constants and
callees.
"""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_write
from drivesplat.kernels.cache_folder import cache_folder
from drivesplat.kernels.numba_private import cached_on_disk
from drivesplat.provenance.code.code_digest import code_digest

OPTIONS = {"nogil": True, "error_model": "numpy"}
callee = numba.njit(**OPTIONS)
"""Compiles a function that only kernels call; it is cached as part of them."""
fast_callee = numba.njit(**OPTIONS, fastmath={"reassoc", "contract", "nsz", "arcp"})
"""As `callee`, for loops that are to be vectorised: sums may be reordered."""


def kernel(function: Callable[..., Any] | None = None, *, fastmath: bool = False) -> Callable[..., Any]:
    """Compiles a function, or returns a decorator that does, to run without the GIL.

    The cache is in NUMBA_CACHE_DIR, in the package's __pycache__, or in the user's cache folder. Where none of these is
    writable, each process compiles again.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath)
    options = {**OPTIONS, "fastmath": fastmath}
    configured = numba.config.CACHE_DIR
    try:
        source = _cached_source(Path(function.__code__.co_filename), configured)
        function.__code__ = function.__code__.replace(co_filename=str(source))
        numba.config.CACHE_DIR = str(source.parent)
        return cached_on_disk(numba.njit(**options)(function))
    except (OSError, RuntimeError, ResultError):  # no folder is writable
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = configured


@cache
def _cached_source(file: Path, configured: str) -> Path:
    """A copy of `file` in its cache folder. numba names cache entries by the path of the source: with this path every
    checkout of the same code shares them. Raises ResultError where the copy cannot be written."""
    source = cache_folder(file.stem, code_digest(file), configured) / file.name
    if not source.exists():
        with atomic_write(source) as copy:
            copy.write(file.read_bytes())
    os.utime(source.parent)
    return source
