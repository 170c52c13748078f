"""How much room a disk has."""

import shutil
from pathlib import Path


def disk_of(folder: Path) -> Path:
    """The folder itself, or the nearest above it that is there: on the disk where it would be made."""
    path = folder.absolute()
    return next(place for place in (path, *path.parents) if place.is_dir())


def free_bytes(folder: Path) -> int:
    """What is free on the disk where a folder is, or would be made."""
    return shutil.disk_usage(disk_of(folder)).free
