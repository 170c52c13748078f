"""Tables of a tiny drive as files that a test may damage, and its extraction under a time limit."""

import json
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drivesplat.preprocess.extract import extract_scene
from drivesplat.scene.scene import Scene
from helpers.drives import VERSION, source
from helpers.patience import PATIENCE_S


class Hang(BaseException):
    """A call that does not end. No library catches it, unlike an Exception."""


@contextmanager
def time_limit() -> Iterator[None]:
    """Raises Hang in its block after PATIENCE_S."""

    def stop(*_) -> None:
        raise Hang(f"it does not end within {PATIENCE_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def copy_of(root: Path, folder: Path) -> Path:
    """A copy of a dataset's tables in `folder`, with links to its other files."""
    shutil.copytree(root / VERSION, folder / VERSION)
    for other in ("samples", "sweeps", "maps"):
        if (root / other).is_dir():
            (folder / other).symlink_to(root / other)
    return folder


def edit(root: Path, table: str, change: Callable[[list[dict]], object]) -> None:
    """Changes the rows of a table in place, or replaces them by what `change` returns."""
    path = root / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    changed = change(rows)
    path.write_text(json.dumps(rows if changed is None else changed))


def row(rows: list[dict], token: str) -> dict:
    """The row with a token."""
    return next(row for row in rows if row["token"] == token)


def extracted(root: Path, **changes) -> Scene:
    """Scene 0001 with its images and sweeps between key frames. Raises Hang where it does not end."""
    with time_limit():
        return extract_scene(source(**{"lidar_sweeps": True, **changes}), root)
