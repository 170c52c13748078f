"""Folders on disk for compiled code. Each belongs to one state of the code that it was compiled from."""

import os
import shutil
import time
from contextlib import suppress
from pathlib import Path

MAX_UNUSED_S = 14 * 24 * 3600
"""Seconds after which unused compiled code is removed; another run may use an older version until then."""


def cache_folder(name: str, digest: str, configured: str = "") -> Path:
    """The folder for what is compiled from the module `name`, whose code and that of all it imports has a `digest`: in
    the `configured` folder, or else in the first writable one of the package's __pycache__ and the user's cache.
    Removes folders of the module that have long been unused."""
    package, user = Path(__file__).parents[1] / "__pycache__", Path.home() / ".cache" / "drivesplat"
    writable = (folder for folder in (package, user) if _writable(folder))
    parent = Path(configured) if configured else next(writable, package)
    folder = parent / f"kernels-{name}-{digest[:16]}"
    for other in parent.glob(f"kernels-{name}-*"):
        with suppress(OSError):
            if other != folder and time.time() - other.stat().st_mtime > MAX_UNUSED_S:
                shutil.rmtree(other)
    return folder


def _writable(folder: Path) -> bool:
    """Whether files can be created in a folder, which need not exist yet."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    return os.access(existing, os.W_OK | os.X_OK)
