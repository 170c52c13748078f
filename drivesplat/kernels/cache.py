"""Functions compiled by numba, cached on disk for as long as nothing changes that may be compiled into them.

numba itself looks at the time of a function's own file alone, and would keep what it compiled from an imported constant
or callee for ever.
"""

import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba

from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_write
from drivesplat.provenance.code_digest import code_digest

KEPT_S = 14 * 24 * 3600
"""How long (seconds) what is compiled is kept unused: another run may still be at it."""


OPTIONS = {"nogil": True, "error_model": "numpy"}
callee = numba.njit(**OPTIONS)
"""Compiles a function that kernels alone call: it is kept with them."""


def kernel(function: Callable[..., Any] | None = None, *, fastmath: bool = False) -> Callable[..., Any]:
    """Compiles a function (or makes a decorator that does) to run without the GIL.

    What has been compiled is kept in NUMBA_CACHE_DIR, or beside this file, or in the user's cache. Where none of these
    can be written, each process compiles anew.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath)
    options = {**OPTIONS, "fastmath": fastmath}
    given = numba.config.CACHE_DIR
    try:
        source = _kept_source(Path(function.__code__.co_filename), given)
        function.__code__ = function.__code__.replace(co_filename=str(source))
        numba.config.CACHE_DIR = str(source.parent)
        return numba.njit(cache=True, **options)(function)
    except (OSError, RuntimeError, ResultError):  # from here, and from numba
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = given


@cache
def _kept_source(file: Path, given: str) -> Path:
    """A copy of `file` in the folder for what is compiled from it. numba files what it compiles under the path of the
    source: under this one, every checkout with the same code finds it. Raises ResultError where it cannot be written.
    """
    kept = _cache_folder(file, given) / file.name
    if not kept.exists():
        with atomic_write(kept) as copy:
            copy.write(file.read_bytes())
    os.utime(kept.parent)
    return kept


def _cache_folder(file: Path, given: str) -> Path:
    """The folder for what is compiled from `file` and the code it imports, below the first that can be written of
    `given`, the package's __pycache__, and the user's cache. What went unused there for weeks is removed."""
    beside, users = Path(__file__).parents[1] / "__pycache__", Path.home() / ".cache" / "drivesplat"
    parent = Path(given) if given else next((folder for folder in (beside, users) if _writable(folder)), beside)
    folder = parent / f"kernels-{file.stem}-{code_digest(file)[:16]}"
    for other in parent.glob(f"kernels-{file.stem}-*"):
        with suppress(OSError):
            if other != folder and time.time() - other.stat().st_mtime > KEPT_S:
                shutil.rmtree(other)
    return folder


def _writable(folder: Path) -> bool:
    """Whether a file can be made in a folder, or in the one that it would be made in."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return os.access(there, os.W_OK | os.X_OK)
