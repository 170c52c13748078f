"""Functions compiled by numba, cached on disk for as long as nothing changes that may be compiled into them.

numba itself looks at the time of a function's own file alone, and would keep what it compiled from an imported constant
or callee for ever.
"""

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba

from drivesplat.rerun import code_digest


def kernel(function: Callable[..., Any] | None = None, *, fastmath: bool = False) -> Callable[..., Any]:
    """Compiles a function (or makes a decorator that does) to run without the GIL.

    What has been compiled is kept in NUMBA_CACHE_DIR, or beside the file. Where numba finds no place to write, neither
    there nor in the user's cache, each process compiles anew.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath)
    options = {"nogil": True, "error_model": "numpy", "fastmath": fastmath}
    given = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(_cache_folder(Path(function.__code__.co_filename), given))
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:
        return numba.njit(**options)(function)
    finally:
        numba.config.CACHE_DIR = given


def _cache_folder(file: Path, given: str) -> Path:
    """The folder for what is compiled from `file` and the code it imports; those of earlier code are removed."""
    parent = Path(given) if given else file.parent / "__pycache__"
    folder = parent / f"kernels-{file.stem}-{code_digest(file)[:16]}"
    if not folder.exists():
        for earlier in parent.glob(f"kernels-{file.stem}-*"):
            with suppress(OSError):
                shutil.rmtree(earlier)
    return folder
